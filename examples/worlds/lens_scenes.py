"""Links seen through a lens, and how near an estimated lens comes to it, for the tests of the choice of the lens."""

import numpy as np

from examples.worlds.alignment_scenes import Scene, grid, scene
from rdstitch.geometry.camera import Camera

SIZE = (640, 480)
FISHEYE = Camera(SIZE, -0.49, -0.055, (335.0, 226.0), distortion3=-0.008)


def lens_scene(lens: Camera, seed: int, *, relief: float = 0.0, columns: int = 4, rows: int = 3) -> Scene:
    """Links of a grid of images through a lens."""
    rng = np.random.default_rng(seed)
    poses = grid(columns, rows, (0.4, 0.35), np.pi, rng)
    return scene(poses, lens=lens, rng=rng, noise=0.25, relief=relief, focal=420.0)


def lens_distance(found: Camera, truth: Camera) -> float:
    """Largest distance of the two lenses, pixels, after the best similarity of the undistorted images."""
    u, v = np.meshgrid(np.linspace(0, SIZE[0] - 1, 15), np.linspace(0, SIZE[1] - 1, 11))
    points = np.column_stack([u.ravel(), v.ravel()])
    ours, theirs = (camera.normalize(camera.undistort(points)) for camera in (found, truth))
    design = np.column_stack([ours, np.ones(len(ours))])
    mapped = design @ np.linalg.lstsq(design, theirs, rcond=None)[0]
    return float(np.linalg.norm(truth.distort(truth.denormalize(mapped)) - points, axis=1).max())
