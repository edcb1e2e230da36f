"""How well few coefficients describe fisheyes and Brown lenses: ``python -m tests.benchmarks.lens_models``.

Printed are rms and largest distance in measured pixels over an image of 1000 x 750, up to the scale of the undistorted
image. ``division k``: ``x_u = x_d / (1 + c1 r² + … + ck r^2k)``; ``rational``: with ``1 + a r²`` above two of those;
``angle k``: Kannala and Brandt's ``r = f (θ + k1 θ³ + …)`` with the focal length and k coefficients.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from rdstitch.arrays import FloatArray

_HALF_DIAGONAL = 625.0
_MEASURED = np.linspace(0.01, 1.0, 200)  # half diagonals
_VIEWS = (90, 120, 140, 150)  # degrees, corner to corner
_BROWN = (  # k1, k2, k3, and the focal length in half diagonals
    (0.08, -0.15, 0.08, 1.5),
    (-0.05, 0.02, 0.0, 1.2),
    (-0.28, 0.09, -0.012, 1.0),
    (-0.25, 0.1, -0.012, 0.9),
)

Curve = Callable[[FloatArray], FloatArray]


def fisheye(kind: str, view: float) -> FloatArray:
    """Undistorted radii of the measured ones."""
    half = np.radians(view) / 2.0
    if kind == "equidistant":
        return np.asarray(np.tan(_MEASURED * half) / half)
    if kind == "equisolid":
        focal = 0.5 / np.sin(half / 2.0)
        return np.asarray(focal * np.tan(2.0 * np.arcsin(_MEASURED / (2.0 * focal))))
    focal = 0.5 / np.tan(half / 2.0)
    return np.asarray(focal * np.tan(2.0 * np.arctan(_MEASURED / (2.0 * focal))))


def brown(k1: float, k2: float, k3: float, focal: float) -> FloatArray:
    """Undistorted radii of the measured ones; the polynomial grows that far."""
    x = np.linspace(0.0, 8.0, 200_001)
    bent = x * (1.0 + x**2 * (k1 + x**2 * (k2 + x**2 * k3)))
    end = int(np.argmax(np.diff(bent) <= 0.0)) or len(x) - 1
    return np.asarray(np.interp(_MEASURED / focal, bent[:end], x[:end]) * focal)


def division(parameters: FloatArray) -> FloatArray:
    """Undistorted radii by even coefficients."""
    return np.asarray(
        _MEASURED / _positive(1.0 + sum(c * _MEASURED ** (2 * k) for k, c in enumerate(parameters, start=1)))
    )


def rational(parameters: FloatArray) -> FloatArray:
    """Undistorted radii by two coefficients below and one above."""
    q = _MEASURED**2
    return np.asarray(_MEASURED * (1.0 + parameters[2] * q) / _positive(1.0 + parameters[0] * q + parameters[1] * q**2))


def angle(parameters: FloatArray) -> FloatArray:
    """Undistorted radii by log focal length and coefficients of the angle, which Newton's method finds."""
    focal, theta = np.exp(parameters[0]), _MEASURED / np.exp(parameters[0])
    for _ in range(30):
        value = theta * (1.0 + sum(c * theta ** (2 * k) for k, c in enumerate(parameters[1:], start=1)))
        slope = 1.0 + sum((2 * k + 1) * c * theta ** (2 * k) for k, c in enumerate(parameters[1:], start=1))
        theta = theta - (value - _MEASURED / focal) / np.maximum(slope, 0.1)
    return np.asarray(np.where(np.abs(theta) < np.pi / 2, np.tan(theta) * focal, np.nan))


def _positive(values: FloatArray) -> FloatArray:
    return np.asarray(np.where(values > 0.0, values, np.nan))


def misfit(model: Curve, size: int, truth: FloatArray) -> tuple[float, float]:
    """Rms and largest distance of the best fit, pixels; radii count by the area that they stand for."""
    weight, slope = np.sqrt(_MEASURED), np.gradient(truth, _MEASURED)

    def residual(parameters: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            off = (model(parameters[1:]) * np.exp(parameters[0]) - truth) / slope * _HALF_DIAGONAL
        return np.asarray(np.nan_to_num(off * weight, nan=1e3, posinf=1e3, neginf=-1e3))

    starts = [np.zeros(size + 1) for _ in range(3)]
    for start, first in zip(starts, (-0.3, 0.3, -0.5), strict=True):
        start[1] = first
    fits = [least_squares(residual, start, method="lm", max_nfev=300) for start in starts]
    error = min(fits, key=lambda fit: float(fit.cost)).fun / weight
    return float(np.sqrt(np.average(error**2, weights=_MEASURED))), float(np.abs(error).max())


def main() -> None:
    """Print the table."""
    models: dict[str, tuple[Curve, int]] = {
        **{f"division {k}": (division, k) for k in (1, 2, 3, 4)},
        "rational": (rational, 3),
        **{f"angle {k}": (angle, k + 1) for k in (1, 2, 3)},
    }
    kinds = ("equidistant", "equisolid", "stereographic")
    lenses = {f"{kind} {view}°": fisheye(kind, view) for kind in kinds for view in _VIEWS}
    lenses |= {f"Brown {k}": brown(*k) for k in _BROWN}
    print(f"{'':36s}" + "".join(f"{name:>16s}" for name in models))
    for name, truth in lenses.items():
        found = [misfit(model, size, truth) for model, size in models.values()]
        print(f"{name:36s}" + "".join(f"{f'{rms:.3f} {largest:.3f}':>16s}" for rms, largest in found), flush=True)


if __name__ == "__main__":
    main()
