"""Images warped by the package ``stitching``.

It stitches with its defaults, but does not crop; every warped image is kept as it is blended, with its mask, what its
seams leave of it, and its place. The package runs in a Python of its own, which imports this file.
"""

import math
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PeerLayer:
    """A warped image."""

    pixels: NDArray[np.uint8]  # (h, w, 3): BGR
    mask: NDArray[np.uint8]  # (h, w): where it shows something
    kept: NDArray[np.uint8]  # (h, w): what its seams leave of it
    corner: tuple[int, int]  # x, y


def layers_of_peer(python: str, files: list[str], output: Path | None = None) -> tuple[list[PeerLayer], float]:
    """The layers of some images, by a Python that has the package, and its processor time; none where it fails.

    ``output`` is where its stitched image is written to.
    """
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder, "layers.npz")
        code = "import sys, peer_layers; peer_layers.save_layers(sys.argv[1], sys.argv[2:])"
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
        done = subprocess.run(
            [python, "-c", code, str(saved), *files], env=environment, capture_output=True, check=False
        )
        if done.returncode:
            return [], math.nan
        with np.load(saved) as arrays:
            if output is not None:
                output.write_bytes(arrays["stitched"].tobytes())
            columns = [[arrays[f"{name}{k}"] for k in range(arrays["count"])] for name in ("pixels", "mask", "kept")]
            corners = [(int(x), int(y)) for x, y in arrays["corners"]]
            seconds = float(arrays["seconds"])
        return [PeerLayer(*layer) for layer in zip(*columns, corners, strict=True)], seconds


def save_layers(saved: str, files: list[str]) -> None:
    """Stitch, and save everything as arrays of NumPy; in a Python that has the package."""
    import cv2
    from stitching import Stitcher  # type: ignore[import-not-found, unused-ignore]

    arrays: dict[str, Any] = {}
    places: list[tuple[int, int]] = []

    class Recording(Stitcher):  # type: ignore[misc, unused-ignore]
        def blend_images(self, imgs: Any, masks: Any, corners: Any) -> None:
            def recorded() -> Any:
                for image, kept, corner in zip(imgs, masks, corners, strict=True):
                    k = len(places)
                    places.append(corner)
                    arrays.update({f"pixels{k}": image, f"mask{k}": self.get_mask(k), f"kept{k}": kept})
                    yield image, kept

            layers = list(recorded())
            super().blend_images([image for image, _ in layers], [kept for _, kept in layers], corners)

    stitched = Recording(crop=False).stitch(files)
    arrays = {name: cv2.UMat.get(array) if isinstance(array, cv2.UMat) else array for name, array in arrays.items()}
    seconds = time.process_time()
    jpeg = cv2.imencode(".jpg", stitched)[1]
    np.savez(saved, count=len(places), seconds=seconds, corners=places, stitched=jpeg, **arrays)
