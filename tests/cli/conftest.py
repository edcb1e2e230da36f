"""Small rendered images, and the command line run in this process."""

import shutil
from pathlib import Path

import pytest
from rdstitch_cli.main import run

from rdstitch.synthetic import Sequence
from tests.cli.running import Outcome, Run, check_sidecar, flight


@pytest.fixture(scope="session")
def sequence() -> Sequence:
    """The truth about ``frames``."""
    return flight(3, 3)


@pytest.fixture(scope="session")
def frames(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three images of 400 x 300 px that overlap in a chain; never written to."""
    return sequence.write(tmp_path_factory.mktemp("frames"))


@pytest.fixture(scope="session")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of other ground."""
    return flight(9, 1).write(tmp_path_factory.mktemp("stranger"), "stranger_{}.png")[0]


@pytest.fixture
def place(tmp_path: Path, frames: list[Path]) -> Path:
    """A folder with two good images, ``a.png`` and ``b.png``."""
    for name, frame in zip("ab", frames[:2], strict=True):
        shutil.copy(frame, tmp_path / f"{name}.png")
    return tmp_path


@pytest.fixture
def rdstitch(capsys: pytest.CaptureFixture[str]) -> Run:
    """``rdstitch(*arguments)``: run the command line in this process."""

    def call(*arguments: str | Path) -> Outcome:
        capsys.readouterr()
        status = run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        if status == 0 and "-o" in arguments:
            check_sidecar(Path(f"{arguments[arguments.index('-o') + 1]}.json"))
        return Outcome.of(status, captured.out, captured.err)

    return call
