"""What a run says of its own result reaches the user, whichever command runs."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from rdstitch.camera import Camera
from rdstitch.messages import Message
from rdstitch.pipeline import accept
from rdstitch.verification.findings import Finding
from tests.cli.running import CACHED, DISTORTION, Run, flight

# Without a focal length, a path says that its lengths are guessed.
GIVEN = (*CACHED, "--focal", "380")
OUTPUTS = {"pano": "out.png", "mosaic": "out.png", "calibrate": "camera.json", "trajectory": "path.csv"}


def _pretend(monkeypatch: pytest.MonkeyPatch, *found: Message) -> None:
    findings = tuple(Finding("pretended", severity=message.severity) for message in found)
    monkeypatch.setattr(accept, "judge", lambda *arguments, **options: findings)
    monkeypatch.setattr(accept, "messages_of", lambda *arguments: list(found))


@pytest.mark.parametrize("command", OUTPUTS)
def test_warnings_are_printed(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    _pretend(monkeypatch, Message("look at that seam"))
    done = rdstitch(command, *frames, "-o", tmp_path / OUTPUTS[command], *GIVEN)
    # What calibrate prints of the lens comes after it.
    assert done.err.splitlines()[0] == "rdstitch: warning: look at that seam"


@pytest.mark.parametrize("command", OUTPUTS)
def test_what_fails_is_written_with_force_only_and_then_reported(
    rdstitch: Run, frames: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    _pretend(monkeypatch, Message("the images disagree", severity="failure"))
    output = tmp_path / OUTPUTS[command]
    rdstitch(command, *frames, "-o", output, *GIVEN, status=4, told="the images disagree")
    assert not output.exists()
    forced = rdstitch(command, *frames, "-o", output, *GIVEN, "--force")
    assert forced.err.splitlines()[0] == "rdstitch: warning: not reliable: the images disagree"
    assert output.exists()


def test_two_images_of_two_lenses_are_noticed(rdstitch: Run, tmp_path: Path) -> None:
    sequence = flight(3, 2)
    assert isinstance(sequence.lens, Camera)
    other = replace(sequence, lens=replace(sequence.lens, distortion=-0.12))
    images = [sequence.write(tmp_path, "own_{}.png")[0], other.write(tmp_path, "other_{}.png")[1]]
    done = rdstitch("pano", *images, "-o", tmp_path / "out.png", *CACHED, status=4)
    found = re.search(
        r"two lenses or zooms are mixed: (\w+\.png) \(λ about (-0\.\d+)\) and (\w+\.png) \((-0\.\d+)\)", done.line
    )
    seen = {found[1]: float(found[2]), found[3]: float(found[4])}
    assert seen == {"own_0.png": pytest.approx(-0.2, abs=0.02), "other_1.png": pytest.approx(-0.12, abs=0.02)}
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("strict", [False, True])
def test_images_of_two_lenses_are_parted(rdstitch: Run, frames: list[Path], tmp_path: Path, strict: bool) -> None:
    sequence = flight(3, 5)
    assert isinstance(sequence.lens, Camera)
    zoomed = replace(sequence, lens=replace(sequence.lens, distortion=-0.12))
    own, others = sequence.write(tmp_path, "own_{:04d}.png")[:3], zoomed.write(tmp_path, "other_{:04d}.png")[3:]
    extra = ("--strict",) if strict else ()
    done = rdstitch("mosaic", *own, *others, "-o", tmp_path / "out.png", *extra, *CACHED, status=5 if strict else 0)
    assert all(path.name in done.err for path in others)
    assert not any(path.name in done.err for path in own)
    assert re.search(
        r"another lens or zoom setting \(λ about -0\.1[12]\d, that of the others -0\.(19|20)\d\)", done.err
    )
    assert strict or abs(float(done.out) - DISTORTION) < 0.002
