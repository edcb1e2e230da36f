"""Options of the recipes."""

from pathlib import Path
from typing import Any, get_args

import pytest

from rdstitch import StitchOptions
from rdstitch.alignment import LENSES, MODELS
from rdstitch.choices import LensName, ModelName, ProjectionName
from rdstitch.compositing.projection import PROJECTIONS
from rdstitch.errors import ArgumentError


def test_text_is_as_good_as_a_path() -> None:
    named: Any = "folder/camera.json"
    options = StitchOptions(cache=named, save_camera=named)
    assert options.cache == options.save_camera == Path("folder/camera.json")
    assert StitchOptions().cache is None


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"solver": "twenty_point"}, "twenty_point"),
        ({"model": "wavy"}, "wavy"),
        ({"lens": "glass"}, "glass"),
        ({"lens": "division2", "distortion": -0.1}, "known lens"),
        ({"solver": "two_point"}, "tilt"),
        ({"solver": "five_point", "distortion": -0.1}, "known λ"),
        ({"distortion": 1.0}, "between -1 and 1"),
        ({"focal": 0.0}, "positive"),
        ({"attitude_std": -1.0}, "negative"),
        ({"confidence": 1.0}, "confidence"),
        ({"local_alignment": 1}, "cells"),
        ({"scheduler": "tcp://somewhere:8786"}, "--cache"),
        ({"seed": -1}, "negative"),
        ({"workers": 10**20}, "workers must be at most"),
    ],
)
def test_what_contradicts_itself_is_refused(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ArgumentError, match=named):
        StitchOptions(**wrong)


def test_the_types_name_what_there_is() -> None:
    assert get_args(LensName) == ("auto", *LENSES)
    assert get_args(ModelName) == ("auto", *MODELS)
    assert get_args(ProjectionName) == ("auto", *PROJECTIONS)
