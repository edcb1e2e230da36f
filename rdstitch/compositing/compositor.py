"""The compositor: images, cameras and homographies in, one image out, in memory or in a file."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rdstitch.arrays import AnyArray, UInt8Array
from rdstitch.compositing.canvas import Canvas
from rdstitch.compositing.photometric import Exposure
from rdstitch.compositing.preparation import Decisions, decide, prepare_composite
from rdstitch.compositing.projection import TURN
from rdstitch.compositing.seam_finder import SeamMap
from rdstitch.compositing.source_images import PlacedImage
from rdstitch.compositing.tiles import BlockRunner, strips_of
from rdstitch.io.fingerprint import Fingerprint
from rdstitch.io.formats import check_format, check_memory
from rdstitch.io.metadata import Metadata
from rdstitch.io.strips import ImageSpec
from rdstitch.io.tiff import ExtraTag
from rdstitch.io.write import write_strips
from rdstitch.options.composite_options import CompositeOptions
from rdstitch.results.messages import Message
from rdstitch.system.outputs import Outputs
from rdstitch.system.progress import FractionProgress, silent


@dataclass(frozen=True, repr=False, eq=False)
class Composite:
    """The stitched image."""

    # (H, W) or (H, W, C): in the sample type of the images, RGB order; 0 where no image lies
    pixels: AnyArray
    alpha: UInt8Array  # (H, W), uint8: 255 where an image lies, else 0
    canvas: Canvas  # geometry of ``pixels``, after cropping
    exposure: Exposure  # what the images were corrected by
    messages: tuple[Message, ...] = ()  # what the user should know, such as why nothing was cropped

    def __repr__(self) -> str:
        return f"<Composite {self.canvas.size[0]} x {self.canvas.size[1]} pixels, {self.pixels.dtype}>"


@dataclass(frozen=True, repr=False)
class FileComposite:
    """A stitched image that went to a file."""

    canvas: Canvas
    fingerprint: Fingerprint  # size and digest of the file
    messages: tuple[Message, ...]
    seams: SeamMap | None  # which image owns what of the canvas before cropping; None without seams
    origin: tuple[int, int]  # where the output begins in that canvas, pixels


def compose(images: Sequence[PlacedImage], canvas: Canvas, options: CompositeOptions | None = None) -> Composite:
    """Put images together on a canvas that was planned for them, in memory."""
    return compose_decided(decide(images, canvas, options or CompositeOptions()))


def compose_decided(
    decisions: Decisions, progress: FractionProgress = silent, elsewhere: BlockRunner | None = None
) -> Composite:
    """Put images together, in memory, once exposure and seams are decided.

    ``elsewhere`` computes the pixels in blocks, in other processes; see :mod:`rdstitch.compositing.tiles`.
    """
    with prepare_composite(decisions, here=elsewhere is None) as tiles:
        renderer, (width, height) = tiles.renderer, tiles.size
        pixels = np.zeros((height, width, renderer.channels), dtype=renderer.dtype)
        alpha = np.zeros((height, width), dtype=np.uint8)
        top = 0
        with closing(strips_of(tiles, elsewhere, progress)) as strips:
            for samples, opaque in strips:
                pixels[top : top + len(samples)], alpha[top : top + len(samples)] = samples, opaque
                top += len(samples)
    shaped = pixels if renderer.channels > 1 else pixels[..., 0]
    return Composite(shaped, alpha, decisions.canvas, renderer.exposure, decisions.messages)


def compose_to_file(
    path: str | Path,
    decisions: Decisions,
    progress: FractionProgress = silent,
    elsewhere: BlockRunner | None = None,
    *,
    metadata: Metadata | None = None,
    extra_tags: Callable[[Canvas], Iterable[ExtraTag]] = lambda canvas: (),
    outputs: Outputs | None = None,
) -> FileComposite:
    """Put images together straight into a file, whatever its size: memory is that of a strip of tiles.

    ``extra_tags`` gives further tags of a TIFF file for the canvas after cropping; without ``outputs`` the file
    replaces what is there.
    """
    with prepare_composite(decisions, here=elsewhere is None) as tiles:
        renderer, canvas, size = tiles.renderer, decisions.canvas, tiles.size
        layout = ImageSpec(
            size,
            renderer.channels,
            renderer.dtype,
            transparent=True,
            metadata=replace(metadata or Metadata(size), xmp=photo_sphere_xmp(canvas)),
            quality=renderer.options.quality,
            background=renderer.options.background,
        )
        check_format(path, layout)
        check_memory(path, size, renderer.options.max_memory)
        # Nothing goes on behind a writer that fails.
        with closing(strips_of(tiles, elsewhere, progress)) as strips:
            tags, workers = extra_tags(canvas), tiles.workers
            written = write_strips(path, layout, strips, tags, outputs=outputs, workers=workers)
    messages = (*decisions.messages, *written.messages)
    return FileComposite(canvas, written.fingerprint, messages, renderer.seams, tiles.box[:2])


def photo_sphere_xmp(canvas: Canvas) -> bytes:
    """XMP packet (GPano) by which viewers recognize an equirectangular image and turn it; empty for others.

    The metadata of Google's Photo Sphere, which also describes images that are only a part of the sphere.
    """
    upright = canvas.matrix[0, 1] == 0.0 and canvas.matrix[1, 0] == 0.0
    if canvas.projection.name != "sphere" or not upright:
        return b""
    resolution = float(canvas.matrix[0, 0])
    full_width, full_height = round(TURN * resolution), round(TURN * resolution / 2.0)
    origin = canvas.matrix[:2, 2] + 0.5
    width, height = canvas.size
    left, top = round(full_width / 2 - origin[0]), round(full_height / 2 - origin[1])
    if canvas.period is not None:
        left %= full_width
    left, top = max(0, min(left, full_width - width)), max(0, min(top, full_height - height))
    numbers = {
        "FullPanoWidthPixels": full_width,
        "FullPanoHeightPixels": full_height,
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
    }
    attributes = " ".join(f'GPano:{name}="{number}"' for name, number in numbers.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        f'GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True" {attributes}/>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()
