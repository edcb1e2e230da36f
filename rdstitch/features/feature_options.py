"""Options of feature detection."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

from rdstitch.choices import FEATURES
from rdstitch.errors import ArgumentError

WORK_MEGAPIXELS = 0.6
"""10⁶ pixels to which images of a large set are halved unless it is said otherwise."""
MAX_FEATURES = 2000
"""Keypoints kept per image of a large set unless it is said otherwise."""
CLOSER = 4.0
"""Times as many pixels are used where the working size shows too little."""

_BUDGET = 8  # images of a large set whose pixels and keypoints fewer images may share among them
_MAX_PIXELS, _MAX_FEATURES = 4.0, 2.0
"""Times as many pixels, and keypoints, that an image of a small set gets at most: keypoints beyond the strongest 4,000
made λ of single pairs of a flight less certain, not more."""


@dataclass(frozen=True)
class FeatureOptions:
    """Choice of the features to detect, and how many.

    Attributes
    ----------
    kind : str
        "rootsift", "sift", "surf", "orb", "akaze" or "aliked".
    max_features : int, optional
        Keypoints kept per image; None: 2,000, and more where there are few images, see :meth:`for_images`.
    work_megapixels : float or "auto", optional
        Images are halved until they have no more megapixels than this before features are detected; None: never;
        "auto": 0.6, and more where there are few images.
    spread : bool
        Keep the strongest of each cell of a grid in turn, rather than the strongest of the image.
    stretch : (float, float), optional
        Grey levels that become 0 and 255; None: those of the set where its images have more than 8 bits, see
        :mod:`rdstitch.pipeline.detect_features`, else none.
    equalize : bool, optional
        Equalize local contrast before detection; None: of a set whose images show too little otherwise.
    aliked_model : path, optional
        ONNX file of the network of "aliked".
    aliked_size : int
        Side of the square image that the network takes, pixels.

    Raises
    ------
    ArgumentError
        When a value is out of range, or the kind unknown.
    """

    kind: str = "rootsift"
    max_features: int | None = None
    work_megapixels: float | Literal["auto"] | None = "auto"
    spread: bool = True
    stretch: tuple[float, float] | None = None
    equalize: bool | None = None
    aliked_model: str | Path | None = None
    aliked_size: int = 640

    def __post_init__(self) -> None:
        if self.kind not in FEATURES:
            raise ArgumentError(f"unknown kind of features {self.kind!r}; known are {', '.join(FEATURES)}")
        if self.kind == "aliked" and self.aliked_model is None:
            raise ArgumentError("features 'aliked' need the ONNX file of the network (--aliked-model)")
        if self.aliked_size < 1:
            raise ArgumentError(f"aliked_size must be at least 1, not {self.aliked_size}")
        if self.max_features is not None and self.max_features < 1:
            raise ArgumentError(f"max_features must be at least 1, not {self.max_features}")
        if isinstance(self.work_megapixels, str):
            if self.work_megapixels != "auto":
                raise ArgumentError(f"work_megapixels is a number, 'auto' or None, not {self.work_megapixels!r}")
        elif self.work_megapixels is not None and not self.work_megapixels > 0:
            raise ArgumentError(f"work_megapixels must be positive, not {self.work_megapixels}")

    def for_images(self, count: int) -> Self:
        """The same with numbers for what was left open, which depend on how many images there are.

        A pair takes a second anyway, and all that is known of its lens comes from its own keypoints; hundreds of
        images have enough together. Fewer than eight images share what eight would have, up to four times as many
        pixels and twice as many keypoints each.
        """
        share = max(_BUDGET / max(count, 1), 1.0)
        return replace(
            self,
            max_features=self.max_features or round(MAX_FEATURES * min(share, _MAX_FEATURES)),
            work_megapixels=WORK_MEGAPIXELS * min(share, _MAX_PIXELS)
            if self.work_megapixels == "auto"
            else self.work_megapixels,
        )

    @property
    def limits(self) -> tuple[int, float | None]:
        """Keypoints of an image, and its megapixels when they are detected; of many images where that is open."""
        budget = self.for_images(_BUDGET)
        assert budget.max_features is not None
        assert budget.work_megapixels != "auto"
        return budget.max_features, budget.work_megapixels
