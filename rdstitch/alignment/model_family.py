"""All motion models by name: those over a plane, from the least to the most free, and the turn on the spot."""

from rdstitch.alignment.motion_models import PLANAR_MODELS, MotionModel
from rdstitch.alignment.rotation_model import ROTATION

MODELS: dict[str, MotionModel] = {**PLANAR_MODELS, ROTATION.name: ROTATION}
