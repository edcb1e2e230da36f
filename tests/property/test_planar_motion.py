"""Planar motion: composition, decomposition, and the constraints it satisfies."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rdstitch.planar_motion import PlanarMotion, rotation_from_tilt, tilt_from_normal

tilts = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
translations = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)).filter(lambda t: np.hypot(*t) > 0.05)
yaws = st.one_of(st.just(0.0), st.floats(0.05, 3.0), st.floats(-3.0, -0.05))
heights = st.one_of(st.just(1.0), st.floats(0.6, 0.95), st.floats(1.05, 1.6))
scales = st.floats(0.1, 10.0) | st.floats(-10.0, -0.1)


@given(tilt=tilts)
def test_tilt_is_read_back_from_the_normal(tilt: tuple[float, float]) -> None:
    np.testing.assert_allclose(tilt_from_normal(rotation_from_tilt(tilt)[:, 2]), tilt, atol=1e-12)


@given(tilt=tilts, yaw=yaws, translation=translations, height=heights, scale=scales)
def test_decomposition_inverts_composition(
    tilt: tuple[float, float], yaw: float, translation: tuple[float, float], height: float, scale: float
) -> None:
    motion = PlanarMotion(tilt, yaw, translation, height)
    found = PlanarMotion.from_homography(scale * motion.homography())
    np.testing.assert_allclose(found.homography(), motion.homography(), atol=1e-6)
    np.testing.assert_allclose(
        [*found.tilt, found.yaw, *found.translation, found.height], [*tilt, yaw, *translation, height], atol=1e-5
    )


def test_a_hopeless_matrix_still_gives_finite_numbers() -> None:
    for matrix in (np.eye(3), np.diag([1.0, 2.0, 3.0]), -np.eye(3)):
        found = PlanarMotion.from_homography(matrix)
        assert np.isfinite([*found.tilt, found.yaw, *found.translation, found.height]).all()
