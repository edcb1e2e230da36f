"""Features of images, and their matches."""

from rdstitch.features.detect import detect, detect_view
from rdstitch.features.keypoints import Correspondences, Features, PackedFeatures
from rdstitch.features.learned import LightGlue
from rdstitch.features.match import Matcher, match, match_near
from rdstitch.features.overlap import match_overlap
from rdstitch.features.prepared_image import View
from rdstitch.options.feature_options import FeatureOptions

__all__ = [
    "Correspondences",
    "FeatureOptions",
    "Features",
    "LightGlue",
    "Matcher",
    "PackedFeatures",
    "View",
    "detect",
    "detect_view",
    "match",
    "match_near",
    "match_overlap",
]
