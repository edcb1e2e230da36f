"""What leaving out a picture or a pair can heal, and what it would only hide."""

import pytest

from rdstitch.messages import Message, Severity
from rdstitch.pipeline.accept import _concerns_all


@pytest.mark.parametrize(
    ("images", "severity", "expected"),
    [
        (("a.png", "b.png", "c.png"), "failure", True),
        (("a.png", "b.png", "c.png"), "warning", False),
        (("a.png", "b.png"), "failure", False),
        (("a.png",), "failure", False),
        ((), "failure", False),
    ],
)
def test_only_failures_of_many_pictures_concern_all(
    images: tuple[str, ...], severity: Severity, expected: bool
) -> None:
    assert _concerns_all([Message("wrong", ("x.png",), "failure"), Message("wrong", images, severity)]) is expected
