"""What a run says of its own result reaches the user, whichever command runs."""

from pathlib import Path

import pytest

from rdstitch.pipeline import recipes
from rdstitch.pipeline.verdict import Verdict
from tests.cli.running import FAST, Run

OUTPUTS = {"pano": "out.png", "mosaic": "out.png", "calibrate": "camera.json", "trajectory": "path.csv"}


def _pretend(monkeypatch: pytest.MonkeyPatch, verdict: Verdict) -> None:
    monkeypatch.setattr(recipes, "judge", lambda *arguments, **options: verdict)


@pytest.mark.parametrize("command", OUTPUTS)
def test_doubts_are_told(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    _pretend(monkeypatch, Verdict(True, (), ("look at that seam",)))
    done = rdstitch(command, *frames, "-o", tmp_path / OUTPUTS[command], *FAST)
    assert done.status == 0
    assert done.line == "rdstitch: warning: look at that seam"


@pytest.mark.parametrize("command", OUTPUTS)
def test_what_fails_is_not_written_unless_forced_and_then_told(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    _pretend(monkeypatch, Verdict(False, ("the pictures disagree",), ()))
    output = tmp_path / OUTPUTS[command]
    refused = rdstitch(command, *frames, "-o", output, *FAST)
    assert refused.status == 4
    assert "the pictures disagree" in refused.line
    assert not output.exists()
    forced = rdstitch(command, *frames, "-o", output, *FAST, "--force")
    assert forced.status == 0
    assert forced.line == "rdstitch: warning: not reliable: the pictures disagree"
    assert output.exists()
