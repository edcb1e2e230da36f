"""What goes in, and what comes out: python -m examples.before_after PHOTO -o FILE.

Lays a photograph flat, takes six images of it through a lens with λ = -0.35, stitches them, and puts them beside the
result. README shows docs/images/before_after.jpg, of IMG_161122_163239_0001_RGB.JPG of OpenDroneMap's
odm_data_garfield_msp, in the public domain (CC0).
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import rdstitch
from rdstitch.geometry.camera import Camera
from rdstitch.synthetic import ImageTexture, Photometry, Texture, grid_poses, sequence_over

_DISTORTION = -0.35
_TALL, _GAP = 700, 12


def main() -> None:
    """Read the command line, render, stitch, and lay out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    with Image.open(given.photo) as image:
        original = image.convert("RGB")

    def texture(plane: tuple[int, int]) -> Texture:
        # The part of the photo that has the plane's shape.
        height = round(original.width * plane[1] / plane[0])
        top = (original.height - height) // 2
        return ImageTexture(np.asarray(original.resize(plane, box=(0, top, original.width, top + height))))

    lens = Camera((960, 720), distortion=_DISTORTION, focal=900.0)
    poses = grid_poses(lens, 3, 2, overlap=0.45, yaw=0.12, shift=0.05, tilt=(0.06, -0.04), seed=3)
    sequence = sequence_over(texture, lens, poses, photometry=Photometry(vignetting=0.2, noise=0.01), seed=3)
    options = rdstitch.StitchOptions(
        channel_order="rgb", composite=rdstitch.CompositeOptions(background=255), workers=2
    )
    images = sequence.frames()
    result = rdstitch.mosaic(images, options=options)
    print(f"{result!r}; the truth is {_DISTORTION}")
    mosaic = Image.fromarray(np.where(result.alpha[..., None] > 0, result.image, 255).astype(np.uint8))
    side_by_side(images, mosaic).save(given.output, quality=88)


def side_by_side(images: list[NDArray[np.uint8]], mosaic: Image.Image) -> Image.Image:
    """Six images in two columns, and what became of them."""
    small = (_TALL - 2 * _GAP) // 3
    wide = small * 4 // 3
    right = mosaic.resize((round(mosaic.width * _TALL / mosaic.height), _TALL), Image.Resampling.LANCZOS)
    page = Image.new("RGB", (2 * wide + 4 * _GAP + right.width, _TALL), "white")
    for index, image in enumerate(images):
        row, column = divmod(index, 2)
        thumbnail = Image.fromarray(image).resize((wide, small), Image.Resampling.LANCZOS)
        page.paste(thumbnail, (column * (wide + _GAP), row * (small + _GAP)))
    page.paste(right, (2 * wide + 4 * _GAP, 0))
    return page


if __name__ == "__main__":
    main()
