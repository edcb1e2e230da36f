"""What a run will meet, found out at a glance: images, lenses, sharpness, exposure, overlap, effort."""

from rdstitch.doctor.examine import Examination, examine

__all__ = ["Examination", "examine"]
