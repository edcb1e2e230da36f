"""Where in the picture the errors are, and where they have a direction: what the lens model leaves over."""

import numpy as np

from rdstitch.registration import Registration
from rdstitch.report.geometry import residuals
from rdstitch.report.svg import RED, drawing, element, label, section

_WIDTH, _COLUMNS = 640.0, 16
_MIN_MATCHES = 4  # matches in a cell that make a mean
_ARROW = 0.9  # of a cell's width, for the largest mean


def residual_map(registration: Registration) -> str:
    """Errors of all pairs over the area of the picture: rms as grey, mean as an arrow."""
    alignment = registration.alignment
    found = [residuals(registration, fit) for fit in alignment.links if fit.used and fit.rms > 0.0]
    cameras = [alignment.cameras[fit.image2] for fit in alignment.links if fit.used and fit.rms > 0.0]
    if not found:
        return section("Residuals", "There are none.")
    # Pictures of several sizes are laid over one another.
    places = np.concatenate([(p + 0.5) / camera.image_size for (p, _), camera in zip(found, cameras, strict=True)])
    off = np.concatenate([residual for _, residual in found])
    width, height = registration.camera.image_size
    rows = max(1, round(_COLUMNS * height / width))
    cell = np.clip((places * (_COLUMNS, rows)).astype(int), 0, (_COLUMNS - 1, rows - 1)) @ (1, _COLUMNS)
    cells = _COLUMNS * rows
    count = np.bincount(cell, minlength=cells)
    mean = np.stack([np.bincount(cell, off[:, k], cells) for k in (0, 1)], axis=1) / np.maximum(count, 1)[:, None]
    rms = np.sqrt(np.bincount(cell, (off**2).sum(axis=1), cells) / np.maximum(count, 1))
    enough = count >= _MIN_MATCHES
    if not enough.any():
        return section("Residuals", f"There are too few matches ({len(off)}) to draw them over the picture.")
    side, darkest = _WIDTH / _COLUMNS, float(rms[enough].max())
    longest = max(float(np.linalg.norm(mean[enough], axis=1).max()), 1e-9)
    parts = [
        '<defs><marker id="residual" markerWidth="5" markerHeight="5" refX="3" refY="2.5" orient="auto">'
        f'<path d="M0,0 L5,2.5 L0,5 z" fill="{RED}"/></marker></defs>'
    ]
    for index in np.flatnonzero(enough):
        y, x = divmod(int(index), _COLUMNS)
        shade = 255 - round(150 * rms[index] / max(darkest, 1e-9))
        tip = mean[index] / longest * _ARROW * side
        title = f"{count[index]} matches, rms {rms[index]:.2f} pixels, mean {np.linalg.norm(mean[index]):.2f} pixels"
        box = {"x": x * side, "y": y * side, "width": side, "height": side}
        parts.append(element("rect", element("title", title), fill=f"rgb({shade},{shade},{shade})", **box))
        start = np.array([(x + 0.5) * side, (y + 0.5) * side])
        parts.append(
            element(
                "line",
                x1=float(start[0] - tip[0] / 2),
                y1=float(start[1] - tip[1] / 2),
                x2=float(start[0] + tip[0] / 2),
                y2=float(start[1] + tip[1] / 2),
                stroke=RED,
                stroke_width=1.5,
                marker_end="url(#residual)",
            )
        )
    tall = rows * side
    parts.append(
        label(
            0.0,
            tall + 16,
            f"darkest cell: rms {darkest:.2f} pixels; longest arrow: mean of {longest:.2f} pixels in that direction",
        )
    )
    return section(
        "Residuals",
        f"{len(off)} inliers of all pairs over the area of the picture. Arrows that follow a pattern tell of something "
        "that the model does not describe: relief, a rolling shutter, a lens that one λ is not enough for.",
        drawing(_WIDTH, tall + 22, parts, "residuals over the picture"),
    )
