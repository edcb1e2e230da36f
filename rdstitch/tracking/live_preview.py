"""The mosaic of the keyframes so far, written to a file now and then."""

import math
from pathlib import Path
from time import monotonic

from rdstitch.errors import RdstitchError
from rdstitch.inputs.source import Source
from rdstitch.io.write import write_image
from rdstitch.results.messages import Message
from rdstitch.tracking import Preview, TrackingResult

_MEGAPIXELS = 0.08  # 10⁶ pixels that a keyframe is read with


class LivePreview:
    """The preview and its file."""

    def __init__(self, file: Path, refresh: float) -> None:
        self._file, self._refresh, self._mosaic = file, refresh, Preview()
        self._written, self._changed, self._failed = -math.inf, False, False

    def add(self, source: Source, result: TrackingResult) -> list[Message]:
        """Paint a keyframe; write the file when that is due. What fails is told once: the frames are worth more."""
        if self._failed:
            return []
        try:
            self._add(source, result)
        except RdstitchError as error:
            self._failed = True
            return [Message(f"no preview any more: {error}")]
        return []

    def _add(self, source: Source, result: TrackingResult) -> None:
        if result.keyframe and result.placement is not None:
            image = source.read(source.reduction(_MEGAPIXELS))
            self._mosaic.paint(image.pixels, result.placement)
            self._changed = True
        if monotonic() - self._written >= self._refresh:
            self.write()

    def write(self) -> None:
        """Replace the file, if there is anything new."""
        if self._changed and self._mosaic.pixels.size:
            write_image(self._file, self._mosaic.pixels, overwrite=True)
            self._written, self._changed = monotonic(), False
