"""Options of feature detection."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

from rdstitch.choices import FeatureName
from rdstitch.errors import ArgumentError
from rdstitch.options.option import Options, Range, documented, option, reads

WORK_MEGAPIXELS = 0.6  # 10⁶ pixels to which images of a large set are halved unless it is said otherwise
MAX_FEATURES = 2000  # keypoints kept per image of a large set unless it is said otherwise
CLOSER = 4.0  # times as many pixels are used where the working size shows too little
_BUDGET = 8  # images of a large set whose pixels and keypoints fewer images may share among them
# Times as many pixels, and keypoints, that an image of a small set gets at most: keypoints beyond the strongest 4,000
# made λ of single pairs of a flight less certain, not more.
_MAX_PIXELS, _MAX_FEATURES = 4.0, 2.0


@documented
@dataclass(frozen=True)
class FeatureOptions(Options):
    """Choice of the features to detect, and how many."""

    kind: FeatureName = option("rootsift", "Feature detector and descriptor.", flag="--features")
    max_features: int | None = option(
        None,
        "Most features of an image; otherwise 2000, and of fewer than 8 images 16000 together, at most 4000 each.",
        within=Range(least=1),
    )
    work_megapixels: float | Literal["auto"] | None = option(
        "auto",
        "Images are halved until they have no more megapixels before features are detected, once less where that "
        "shows too few; 0 is full size. auto: 0.6; of fewer than 8 images 4.8 together, at most 2.4 each.",
        "auto|MP",
        within=Range(least=0.0),
    )
    spread: bool = option(True, "Keep the strongest of each cell of a grid in turn.", flag=None)
    stretch: tuple[float, float] | None = option(
        None,
        "Grey levels that become 0 and 255; None: those of the set where its images have more than 8 bits, else none.",
        flag=None,
    )
    equalize: bool | None = option(
        None,
        "Equalize local contrast before detection; None: of a set whose images show too little otherwise.",
        flag=None,
    )
    aliked_model: str | Path | None = reads("ONNX file of the network of --features aliked.")
    aliked_size: int = option(
        640, "Side of the square image that the network takes, pixels.", within=Range(least=1), flag=None
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "aliked" and self.aliked_model is None:
            raise ArgumentError("features 'aliked' need the ONNX file of the network (--aliked-model)")
        if self.work_megapixels == 0:
            object.__setattr__(self, "work_megapixels", None)

    def for_images(self, count: int) -> Self:
        """The same with numbers for what was left open: fewer than eight images share what eight would have."""
        factor = max(_BUDGET / max(count, 1), 1.0)
        return replace(
            self,
            max_features=self.max_features or round(MAX_FEATURES * min(factor, _MAX_FEATURES)),
            work_megapixels=WORK_MEGAPIXELS * min(factor, _MAX_PIXELS)
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
