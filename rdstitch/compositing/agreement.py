"""Do two pictures show the same where they overlap? Asked of the pixels, not of the features that registered them.

One picture is resampled as the other's lens would have seen it. In each small cell of the overlap that has texture,
the place where the two correlate best is searched around where the registration says it is. Where the registration is
right nearly all cells find it there; elsewhere they find it anywhere.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rdstitch.camera import Camera, FloatArray
from rdstitch.io.read import Picture
from rdstitch.radial_homography import from_plane, to_plane

Grey = NDArray[np.float32]

_LONGEST_SIDE = 512  # px of the pictures that are compared
_CELL = 24  # px
_REACH = 8  # px
_LEAST_TEXTURE = 0.012  # standard deviation in a cell, of full range
_ALIKE = 0.5  # correlation from which on two cells show the same
_SLACK = 2.5  # px
_MOST_CELLS = 120
_OPAQUE = 250


@dataclass(frozen=True)
class Agreement:
    """What the cells of an overlap say.

    Attributes
    ----------
    cells : int
        Cells with texture in both pictures.
    confirming : int
        Cells that correlate best, and well, where the registration says.
    contradicting : int
        Cells that correlate well, but elsewhere.
    """

    cells: int
    confirming: int
    contradicting: int

    @property
    def share(self) -> float:
        """Share of the cells that confirm the registration; 1 without cells."""
        return self.confirming / self.cells if self.cells else 1.0


def reduced_grey(picture: Picture) -> Grey:
    """A picture as :func:`overlap_agreement` takes it: grey in [0, 1], small, NaN where transparent."""
    pixels = picture.pixels
    full = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else max(float(pixels.max()), 1e-12)
    height, width = pixels.shape[:2]
    factor = min(1.0, _LONGEST_SIDE / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(full)
    grey: Grey = small if small.ndim == 2 else small.mean(axis=2, dtype=np.float32)
    if picture.alpha is not None:
        grey[cv2.resize(picture.alpha, size, interpolation=cv2.INTER_AREA) < _OPAQUE] = np.nan
    return grey


def overlap_agreement(
    grey1: Grey, grey2: Grey, camera1: Camera, camera2: Camera, homography1: FloatArray, homography2: FloatArray
) -> Agreement:
    """Compare two registered pictures.

    Parameters
    ----------
    grey1, grey2 : ndarray of shape (h, w), float32
        Grey pictures in [0, 1], of the size of their cameras; NaN where transparent.
    camera1, camera2 : Camera
    homography1, homography2 : ndarray of shape (3, 3)
        From undistorted normalized coordinates of each picture to the plane.
    """
    height, width = grey2.shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    plane = to_plane(camera2, homography2, np.stack([u, v], axis=-1).reshape(-1, 2))
    # The first picture as the second one's lens would have seen it.
    seen = sampled(grey1, from_plane(camera1, homography1, plane).reshape(height, width, 2))
    margin = _CELL // 2 + _REACH
    rows, columns = (np.arange(margin, n - margin + 1, _CELL) for n in (height, width))
    corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2) - _CELL // 2
    textured = [(top, left) for top, left in corners.tolist() if _has_texture(_cell(seen, top, left))]
    step = max(1, -(-len(textured) // _MOST_CELLS))
    votes = [_vote(seen, grey2, top, left) for top, left in textured[::step]]
    return Agreement(sum(vote is not None for vote in votes), votes.count(1), votes.count(-1))


def sampled(grey: Grey, places: FloatArray) -> Grey:
    """A picture at places (h, w, 2), px; NaN where it does not reach."""
    x, y = (np.nan_to_num(places[..., k], nan=-1e6).astype(np.float32) for k in (0, 1))
    found = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(float("nan"),))
    return np.asarray(found, dtype=np.float32)


def _cell(picture: Grey, top: int, left: int, margin: int = 0) -> Grey:
    return picture[top - margin : top + _CELL + margin, left - margin : left + _CELL + margin]


def _has_texture(cell: Grey) -> bool:
    return bool(np.isfinite(cell).all() and cell.std() > _LEAST_TEXTURE)


def _vote(seen: Grey, grey2: Grey, top: int, left: int) -> int | None:
    """1 for, -1 against, 0 neither; None where the second picture has no texture."""
    window = _cell(grey2, top, left, _REACH)
    if not (np.isfinite(window).all() and _has_texture(_cell(grey2, top, left))):
        return None
    scores = np.asarray(
        cv2.matchTemplate(
            np.ascontiguousarray(window), np.ascontiguousarray(_cell(seen, top, left)), cv2.TM_CCOEFF_NORMED
        )
    )
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    if scores[row, column] < _ALIKE:
        return 0
    return 1 if np.hypot(row - _REACH, column - _REACH) <= _SLACK else -1
