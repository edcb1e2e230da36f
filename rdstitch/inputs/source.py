"""The input images: which files, what their headers say, and the camera each was taken with."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from rdstitch.arrays import UInt8Array
from rdstitch.errors import ArgumentError, InputError, LimitError, RdstitchError
from rdstitch.features.prepared_image import View, halving
from rdstitch.geometry.camera import Camera
from rdstitch.geometry.exif_orientation import inverse, turned_size
from rdstitch.geometry.places import GroundControl
from rdstitch.geometry.planar_motion import rotation_from_tilt
from rdstitch.inputs.decoded_image_cache import DecodedImageCache
from rdstitch.inputs.delays import MeasuredTilt
from rdstitch.inputs.frame import Frame, Named
from rdstitch.inputs.input_guard import InputGuard
from rdstitch.io.flat_field import FlatField
from rdstitch.io.lens_correction import corrected
from rdstitch.io.mask import Mask
from rdstitch.io.metadata import Metadata, read_metadata
from rdstitch.io.read import DecodedImage, read_image, reduced
from rdstitch.io.reduction import block_minimum, fitting_reduction, reduced_size
from rdstitch.io.samples import as_alpha
from rdstitch.options.feature_options import WORK_MEGAPIXELS
from rdstitch.results.messages import Message, left_out
from rdstitch.system.cache import Cache
from rdstitch.system.file_access import held_in_memory, is_url

_HELD_UPRIGHT = 6  # EXIF orientation


@dataclass(frozen=True)
class Source:
    """One input image; its pixels are read when they are needed."""

    path: Path
    metadata: Metadata
    # what is known of the camera before registration: size, centre, focal length, and λ where it was given
    camera: Camera
    mask: Mask | None = None
    attitude: MeasuredTilt | None = None
    # its number and time in the sequence; the pixels, where they are no file
    frame: Frame | None = field(default=None, compare=False, repr=False)
    # where it is kept between two stages that both look at it
    decoded_images: DecodedImageCache = field(
        default_factory=partial(DecodedImageCache, capacity=0), compare=False, repr=False
    )
    # what notices changes of the file, and damage
    guard: InputGuard = field(default_factory=InputGuard, compare=False, repr=False)
    # illumination that is taken out of the pixels
    flat_field: FlatField | None = field(default=None, compare=False, repr=False)
    control: tuple[GroundControl, ...] = ()  # points of known place that it shows

    @property
    def name(self) -> str:
        """Its name in messages, reports and tables; see :class:`rdstitch.inputs.frame.Frame`."""
        return self._frame.name

    @property
    def _frame(self) -> Frame:
        return self.frame or Frame(self.path)

    @property
    def may_be_transparent(self) -> bool:
        """Whether it has a mask, an image circle or alpha."""
        alpha = self.metadata.channels in (2, 4) and not self.metadata.planes
        return alpha or self.mask is not None or self.camera.image_circle is not None

    @property
    def down(self) -> tuple[float, float, float] | None:
        """Unit vector straight down in the camera's axes (right, down, ahead), as measured or as its XMP says."""
        if self.attitude is None:
            return self.metadata.nadir
        x, y, z = rotation_from_tilt(self.attitude.tilt)[:, 2].tolist()
        return x, y, z

    def with_absolute_paths(self) -> Self:
        """The source with absolute paths, for workers elsewhere, where relative ones begin at other folders."""
        mask = None if self.mask is None else replace(self.mask, path=self.mask.path.absolute())
        in_file = self._frame.image is None and not is_url(self.path)
        return replace(self, path=self.path.absolute() if in_file else self.path, mask=mask)

    def content(self, cache: Cache) -> str:
        """Hash of what the image is made from, for keys of the cache; for one of this run alone its name will do."""
        given = self._frame.image
        # Planes of one file may have one name, arrays in memory have names of their own.
        if given is None or (cache.temporary is not None and isinstance(given, DecodedImage)):
            return cache.file(self.path)
        image = self._frame.decoded()
        return cache.digest((image.pixels, image.alpha))

    def mask_content(self, cache: Cache) -> tuple[object, ...]:
        """Hash of its mask, with the image circle and the lens that it is resampled by."""
        circle = () if self.camera.image_circle is None else (*self.camera.center, self.camera.image_circle)
        resampled = (self.camera,) if self.camera.lens_model is not None else ()
        mask = (None, None) if self.mask is None else (cache.file(self.mask.path), self.mask.frame)
        return *mask, circle, *resampled

    def reduction(self, megapixels: float | None) -> int:
        """Largest reduction that keeps at least as many pixels as an image halved to so many 10⁶ pixels has."""
        return 1 if megapixels is None else fitting_reduction(halving(self.camera.image_size, megapixels))

    def read(self, reduction: int = 1, *, keep: bool = False) -> DecodedImage:
        """Read the pixels, of blocks of so many pixels a side; what the mask excludes is transparent."""
        # Smaller ones are made from one size, whether that is at hand or not: the same comes out.
        usual = self.reduction(WORK_MEGAPIXELS)
        if reduction % usual:
            return self._within_circle(self._load(reduction), reduction)
        # Frames of videos are files of their own by now, so that the path names the frame too; planes are not.
        key = (self.path, id(self._frame.image), self.mask, self.flat_field, self.camera.lens_model)
        image = self.decoded_images.take(key) or self._load(usual)
        if keep:
            self.decoded_images.put(key, image)
        return self._within_circle(reduced(image, reduction // usual), reduction)

    def view(self, megapixels: float | None) -> View:
        """Read what detection at so many 10⁶ pixels needs; it is kept for the stages that read it again."""
        reduction = self.reduction(megapixels)
        image = self.read(reduction, keep=True)
        return View(image.pixels, image.alpha, reduction, self.camera.image_size)

    def _load(self, reduction: int) -> DecodedImage:
        if self._frame.image is None:
            with held_in_memory(self.path), self.guard.reading(self.path):
                image = read_image(self.path, reduction, self.metadata)
        else:
            image = reduced(self._frame.decoded(), reduction)
        self.guard.check(self.path, image)
        expected = self.camera.image_size
        if image.pixels.shape[1::-1] != reduced_size(expected, reduction):
            now, before = ("{} x {}".format(*size) for size in (read_metadata(self.path).size, expected))
            raise InputError(f"{self.path}: has {now} pixels now, but had {before} before; run again")
        if self.flat_field is not None:
            image = replace(image, pixels=self.flat_field.corrected(image.pixels, reduction))
        if self.mask is not None:
            image = _masked(image, block_minimum(self.mask.read(expected), reduction))
        return corrected(image, self.camera, reduction)

    def _within_circle(self, image: DecodedImage, reduction: int) -> DecodedImage:
        """The image without what lies beyond the image circle; its pixels are blocks of so many a side."""
        if self.camera.image_circle is None:
            return image
        x, y = (
            np.arange(count) * reduction + (reduction - 1) / 2 - center
            for count, center in zip(image.pixels.shape[1::-1], self.camera.center, strict=True)
        )
        inside = x**2 + y[:, None] ** 2 <= self.camera.image_circle**2
        return _masked(image, as_alpha(inside))


def _masked(image: DecodedImage, alpha: UInt8Array) -> DecodedImage:
    """The image where both its own alpha and another one have it."""
    return replace(image, alpha=alpha if image.alpha is None else np.minimum(image.alpha, alpha))


def read_sources(
    inputs: Iterable[Named],
    *,
    camera: Camera | None = None,
    focal: float | None = None,
    distortion: float | None = None,
    skip_bad: bool,
    guard: InputGuard | None = None,
    max_memory: int | None = None,
) -> tuple[list[Source], list[Message]]:
    """Read the headers of the images; a file named twice counts once."""
    guard = guard or InputGuard()
    sources: list[Source] = []
    unread: list[Message] = []
    seen: set[Path] = set()
    decoded_images = DecodedImageCache()
    for item in inputs:
        frame = item if isinstance(item, Frame) else Frame(Path(item))
        path = frame.path
        try:
            key = path.resolve()
            metadata = frame.metadata or read_metadata(path)
            _check_memory(path, metadata, max_memory)
        except (InputError, LimitError, OSError, RuntimeError) as error:
            reason = error if isinstance(error, RdstitchError) else InputError(f"{path}: cannot be read: {error}")
            if not skip_bad:
                raise reason from error
            unread.append(left_out(path, str(reason)))
            continue
        if frame.image is not None or key not in seen:
            seen.add(key)
            known = _camera(metadata, camera, focal, distortion)
            sources.append(Source(path, metadata, known, frame=frame, decoded_images=decoded_images, guard=guard))
    return sources, unread


def _check_memory(path: Path, metadata: Metadata, max_memory: int | None) -> None:
    """Refuse an image before it is decoded: it is then there twice, as the compositor also reckons."""
    width, height = metadata.size
    need = 2 * width * height * metadata.channels * -(-metadata.bit_depth // 8)
    if max_memory is not None and need > max_memory:
        raise LimitError(
            f"{path}: {width} x {height} pixels need {need / 2**20:.0f} MB to be decoded, and --max-memory allows "
            f"{max_memory / 2**20:.0f} MB; raise it, or make the image smaller"
        )


def _camera(metadata: Metadata, camera: Camera | None, focal: float | None, distortion: float | None) -> Camera:
    """The best that is known of one image's camera: what the user says, then EXIF; the guess comes later."""
    known = Camera(metadata.size) if camera is None else _fitted(camera, metadata)
    if focal is not None:
        known = known.with_focal(focal, "option")
    elif known.focal_source in (None, "guess") and metadata.focal_px is not None:
        known = known.with_focal(metadata.focal_px, "exif")
    return known if distortion is None else known.with_coefficients(distortion)


def _fitted(camera: Camera, metadata: Metadata) -> Camera:
    """A known camera for an upright image: it belongs to the frame, stored or upright, whose shape it has.

    Where the image is turned by a quarter and no tag says which way, as cameras are that are held upright.
    """
    upright, orientation = metadata.size, metadata.orientation
    for turning in (orientation, 1, _HELD_UPRIGHT):
        size = turned_size(upright, inverse(turning))
        if abs(size[0] * camera.image_size[1] / (size[1] * camera.image_size[0]) - 1.0) < 0.02:
            return camera.resized(size).turned(turning)
    raise ArgumentError(
        f"the camera file is for {camera.image_size[0]} x {camera.image_size[1]} pixels; "
        f"an image of {upright[0]} x {upright[1]} pixels was cropped or comes from another camera"
    )
