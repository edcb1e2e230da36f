"""The mosaic of the keyframes so far, written to a file now and then."""

import math
from pathlib import Path
from time import monotonic

from rdstitch.inputs.source import Source
from rdstitch.io.write import write_image
from rdstitch.tracking import Preview, Tracked

_MEGAPIXELS = 0.08  # 10⁶ pixels that a keyframe is read with


class LivePreview:
    """The preview and its file."""

    def __init__(self, file: Path, refresh: float) -> None:
        self._file, self._refresh, self._mosaic = file, refresh, Preview()
        self._written, self._changed = -math.inf, False

    def add(self, source: Source, result: Tracked) -> None:
        """Paint a keyframe; write the file when that is due."""
        if result.keyframe and result.placement is not None:
            image = source.read(source.reduction(_MEGAPIXELS))
            self._mosaic.paint(image.pixels, result.placement)
            self._changed = True
        if monotonic() - self._written >= self._refresh:
            self.write()

    def write(self) -> None:
        """Replace the file, if there is anything new."""
        if self._changed:
            write_image(self._file, self._mosaic.pixels, overwrite=True)
            self._written, self._changed = monotonic(), False
