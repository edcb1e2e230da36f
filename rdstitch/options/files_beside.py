"""What is written beside an image."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

from rdstitch.choices import PosesFrame
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Options, documented, option, options_of, writes
from rdstitch.options.shared_options import Height


@documented
@dataclass(frozen=True)
class ReportFile(Options):
    """What is written of a registration, also of one that is refused."""

    report: Path | None = writes("Write a report to FILE (.html): graph, votes on λ, matches, residuals.")
    command: str = ""  # the command line, for the report


@documented
@dataclass(frozen=True)
class ImageFiles(ReportFile):
    """What is written beside an image, whatever its images are."""

    layers: Path | None = writes(
        "Write each image, warped, with alpha, and its mask into DIR: TIFF, cropped, with the offsets that "
        "enblend reads.",
        "DIR",
    )
    whole_layers: bool = option(False, "With --layers: on the whole canvas instead of cropped.", needs=("layers",))
    hugin_project: Path | None = writes(
        "Write a project for Hugin (.pto): all images with lens and pose, and control points."
    )


@documented
@dataclass(frozen=True)
class FilesBeside(ImageFiles):
    """What is written beside an image, published together with it; the report of a result that is refused too."""

    poses: Path | None = writes(
        "Write the pose of the camera for each image: CSV with covariances, as 'rdstitch trajectory' does; "
        "images.txt: COLMAP's; geo.txt: OpenDroneMap's."
    )
    frame: PosesFrame = option(
        "enu",
        "Axes of --poses. enu, ros, camera: of the first image, as for 'rdstitch trajectory'. first: those of camera, "
        "and the sidecar has them too: the first image is the reference. map: easting, northing and height above the "
        "ground, metres, where the output is georeferenced, without --height.",
    )
    height: Height = None
    map_server: Path | None = writes(
        "Write map.yaml and map.png, which nav2_map_server loads, into DIR; in metres by --height, with the first "
        "image at the origin and its top along x.",
        "DIR",
    )

    @property
    def has_poses_on_map(self) -> bool:
        """Whether the table of poses needs a map: also OpenDroneMap's, by its name; COLMAP's takes it where it is."""
        name = "" if self.poses is None else self.poses.name.lower()
        return name == "geo.txt" or (self.frame == "map" and name not in ("", "images.txt"))

    @classmethod
    def of(cls, kind: type[ReportFile], given: ReportFile, recipe: str) -> Self:
        """All files from those of a kind; others are refused, which a recipe does not write."""
        whole = cls(**vars(options_of(kind, given, "beside")))
        of_kind = {each.name for each in fields(kind)}
        for each in fields(cls):
            if each.name not in of_kind and getattr(whole, each.name) != each.default:
                written = ", ".join(sorted(of_kind - {"command", "whole_layers"}))
                raise ArgumentError(f"{recipe} writes no {each.name}: beside its result there may be {written}")
        return whole


NOTHING_BESIDE = FilesBeside()
