"""A plane with straight lines on it: what straightening and upright views are tested with."""

from dataclasses import dataclass

import numpy as np

from rdstitch.arrays import FloatArray
from rdstitch.synthetic.textures import LinearPixels, Texture


@dataclass(frozen=True)
class LinedTexture:
    """A texture with straight lines painted on it: roads, joints, markings."""

    texture: Texture
    lines: FloatArray  # end points, texels; shape (L, 2, 2)
    width: float = 6.0
    level: float = 1.0

    @property
    def size(self) -> tuple[int, int]:
        return self.texture.size

    @property
    def channels(self) -> int:
        return self.texture.channels

    def region(self, left: int, top: int, right: int, bottom: int) -> LinearPixels:
        painted = self.texture.region(left, top, right, bottom).copy()
        x, y = np.arange(left, right), np.arange(top, bottom)[:, None]
        for start, end in self.lines:
            along = (end - start) / np.linalg.norm(end - start)
            share = np.clip((x - start[0]) * along[0] + (y - start[1]) * along[1], 0.0, np.linalg.norm(end - start))
            distance = np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])
            cover = np.clip(self.width / 2.0 + 0.5 - distance, 0.0, 1.0).astype(np.float32)[:, :, None]
            painted += cover * (np.float32(self.level) - painted)
        return painted
