"""Where each rule begins: values just below and just above its limit."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rdstitch.alignment.result import LinkFit
from rdstitch.camera import Camera
from rdstitch.verification import rules
from rdstitch.verification.overlap_check import CheckedLink
from rdstitch.verification.photometric_agreement import Agreement
from rdstitch.verification.self_similarity import Ambiguity

LARGEST = 0.02 * 500.0  # pixels that relief explains, of images with a diagonal of 500


def _kinds(findings: Any) -> list[str]:
    return [finding.kind for finding in findings]


@pytest.mark.parametrize(
    ("rms", "alike", "relief", "kind"),
    [
        (2.99, 0.0, None, None),
        (3.0, 0.0, None, None),  # the definition of an inlier, 3 pixels here
        (3.01, 0.24, None, "errors"),
        (3.01, 0.25, None, "rough"),
        (9.0, 0.25, None, "rough"),  # three thresholds
        (9.01, 0.9, None, "errors"),
        (9.01, 0.5, 9.0, "rough"),  # what neighbours have in common left out, it is a plane
        (9.01, 0.49, 9.0, "errors"),
        (9.5, 0.9, 9.02, "rough"),  # 9.5² - 9.02² = 8.9
        (9.5, 0.9, 9.01, "errors"),  # 9.07: more than 3²
        (LARGEST, 0.9, 9.9, "rough"),
        (LARGEST + 0.01, 0.9, 9.9, "errors"),
        (np.nan, 0.9, None, "errors"),
    ],
)
def test_errors_of_the_whole(rms: float, alike: float, relief: float | None, kind: str | None) -> None:
    ground = SimpleNamespace(found=relief is not None, size=relief or 0.0)
    alignment = SimpleNamespace(rms=rms, relief=ground, cameras=[Camera((400, 300)), Camera((40, 30))])
    found: Any = SimpleNamespace(alignment=alignment, threshold=3.0, alike=alike)
    findings = list(rules._errors(found))
    assert _kinds(findings) == ([] if kind is None else [kind])
    for finding in findings:
        assert finding.severity == ("warning" if kind == "rough" else "failure")
        assert finding.values == pytest.approx({"rms": rms, "threshold": 3.0}, nan_ok=True)


def _checked(cells: int, share: float, pair: tuple[int, int] = (0, 1), *, unique: bool = False) -> Any:
    link = CheckedLink(LinkFit(*pair, 9, 9, 0.5, True), Agreement(cells, round(cells * share)), Ambiguity(1, 0, 0))
    return SimpleNamespace(agreement=link.agreement, pair=link.pair, unique=unique)


def test_of_pairs_that_unique_places_decided_the_least_alike_is_named() -> None:
    seen = [_checked(100, 0.5, unique=True), _checked(100, 0.3, (1, 2), unique=True), _checked(100, 0.1, (2, 3))]
    (finding,) = rules._pattern(SimpleNamespace(ambiguous={}, checked=seen, seen=seen))  # type: ignore[arg-type]
    assert (finding.kind, finding.images) == ("settled pattern", (1, 2))


@pytest.mark.parametrize("certain", [True, False])
def test_images_of_two_lenses_that_were_not_separated(certain: bool) -> None:
    mixed = SimpleNamespace(certain=certain, second=[False, True, False], distortion=(-0.1, -0.4))
    findings = list(rules._mixed_lenses(SimpleNamespace(registration=SimpleNamespace(mixed=mixed))))  # type: ignore[arg-type]
    values = {"images2": [1], "images1": [0, 2], "lens2": -0.4, "lens1": -0.1}
    assert [finding.values for finding in findings] == ([] if certain else [values])
