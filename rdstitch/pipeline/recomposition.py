"""What applying a saved registration gives, and the sidecar of that."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rdstitch.compositing import CompositeOptions
from rdstitch.inputs.frame import ChannelOrder
from rdstitch.inputs.source import Source
from rdstitch.messages import Message
from rdstitch.orientation import inverse
from rdstitch.pipeline.placed_images import PlacedImages
from rdstitch.sidecar.read import SavedRegistration
from rdstitch.sidecar.write import (
    VERSION,
    georeference_fields,
    identity_fields,
    lens_fields,
    output_geometry,
    plain,
    to_output,
    versions,
)
from rdstitch.stitch_result import OutputImage


@dataclass(frozen=True, repr=False, kw_only=True)
class Recomposition(OutputImage):
    """An image made from a saved registration; also as :class:`rdstitch.stitch_result.OutputImage` has it.

    Attributes
    ----------
    saved : SavedRegistration
    sources : tuple of Source or None
        For each image of the registration the one that took its place, with its camera; None where there is none.
    matched : str
        "name" or "order".
    left_out : dict of int to Message
        Images that the registration used and that are not in the output, by their number, with the reason.
    placed : PlacedImages
        Those that are in the output.
    composite_options : CompositeOptions
    messages : tuple of Message
        What the user should know of the compositing, and of the sidecar.
    channel_order : str
        Of :attr:`image`: "bgr" or "rgb".
    """

    saved: SavedRegistration
    sources: tuple[Source | None, ...]
    matched: str
    left_out: Mapping[int, Message]
    placed: PlacedImages
    composite_options: CompositeOptions
    messages: tuple[Message, ...] = ()
    channel_order: ChannelOrder = "bgr"

    @property
    def image_order(self) -> ChannelOrder:
        """Order of the channels of :attr:`image`."""
        return self.channel_order

    @property
    def summary(self) -> str:
        """What was made, and of how many images, in one line."""
        name, (width, height) = "" if self.output is None else f"{self.output}: ", self.canvas.size
        used = sum(source is not None for source in self.sources)
        return f"{name}{width} x {height} pixels, {used} of {used + len(self.left_out)} images"


def applied_sidecar(result: Recomposition) -> dict[str, Any]:
    """The sidecar of a recomposed image: what was estimated then, of the images that are in it now.

    It can be applied like any other. Pairs are those of the sidecar that was applied, and stay there.
    """
    then = result.saved.content
    entries = [_image(result, index, dict(entry)) for index, entry in enumerate(then["images"])]
    reference = next(
        (index for index in (result.saved.reference, *range(len(entries))) if entries[index]["used"]), None
    )
    assert reference is not None, "an image without any image in it is never written"
    source = result.sources[reference]
    assert source is not None
    camera = source.camera
    content = {
        **then,
        "version": VERSION,
        "lambda_px": camera.distortion_px,
        "lambda_focal": camera.distortion_focal,
        "camera": {
            **camera.turned(inverse(source.metadata.orientation)).as_dict(),
            # How far the camera was determined then.
            "lambda_std": then.get("lambda_std"),
            **{name: then["camera"].get(name) for name in ("lens_covariance", "tilt_deg", "tilt_std_deg")},
            "focal_std_px": _resized_std(then["camera"], camera.focal),
        },
        "focal_px": camera.focal,
        "reference": source.name,
        "output": {
            **identity_fields(result.output, result.fingerprint),
            **output_geometry(result.canvas, turned=result.saved.turned),
            "georeference": georeference_fields(result.georeference, result.not_georeferenced),
        },
        "images": entries,
        "pairs": [],
        "options": {**then["options"], "composite": result.composite_options},
        "versions": versions(),
        "applied": {"sidecar": str(result.saved.path), "matched": result.matched},
    }
    return {key: plain(value) for key, value in content.items()}


def _image(result: Recomposition, index: int, entry: dict[str, Any]) -> dict[str, Any]:
    """One image's entry, brought up to date."""
    source, image = result.sources[index], result.saved.images[index]
    if source is None or image.to_plane is None:
        reason = result.left_out[index].text if index in result.left_out else image.reason
        lens = {} if image.camera is None else lens_fields(image.camera)
        return {**entry, **lens, "used": False, "reason": reason, "to_plane": None, "to_output": None, "pose": None}
    to_plane = result.placed.homographies[sum(earlier is not None for earlier in result.sources[:index])]
    return {
        **entry,
        "name": source.name,
        "path": str(source.path),
        "size": source.camera.image_size,
        **lens_fields(source.camera),
        "to_plane": to_plane,
        "to_output": to_output(result.canvas, to_plane),
    }


def _resized_std(then: Mapping[str, Any], focal: float | None) -> float | None:
    """The standard deviation that a focal length had, for the same lens on an image of another size."""
    std, former = then.get("focal_std_px"), then.get("focal_px")
    return std * (focal / former) if std and former and focal else None
