"""Small rendered images, and the command line run in this process."""

from pathlib import Path

import pytest
from rdstitch_cli.main import run

from rdstitch.synthetic import RenderedSequence
from tests.cli.running import CACHED, Outcome, Run, check_sidecar, copied, flight


@pytest.fixture(scope="session")
def sequence() -> RenderedSequence:
    """The truth about ``frames``."""
    return flight(3, 3)


@pytest.fixture(scope="session")
def frames(sequence: RenderedSequence, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three images of 400 x 300 px that overlap in a chain; never written to."""
    return sequence.write(tmp_path_factory.mktemp("frames"))


@pytest.fixture(scope="session")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of other ground."""
    return flight(9, 1).write(tmp_path_factory.mktemp("stranger"), "stranger_{}.png")[0]


@pytest.fixture(scope="session")
def stitched(frames: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mosaic of ``frames`` with some options; never written to."""
    output = tmp_path_factory.mktemp("stitched") / "field.tif"
    arguments = ("mosaic", *frames, "-o", output, "--scale", "0.8", "--rotate", "10", *CACHED)
    assert run([str(argument) for argument in arguments]) == 0
    return output


@pytest.fixture
def place(tmp_path: Path, frames: list[Path]) -> Path:
    """A folder with two good images, ``a.png`` and ``b.png``."""
    copied(frames, tmp_path, "a.png", "b.png")
    return tmp_path


@pytest.fixture
def here(place: Path, frames: list[Path], stranger: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: two good images ``a.png`` and ``b.png``; in ``more`` two again; and one of other ground."""
    copied(frames[:2], place / "more")
    copied([stranger], place, "stranger.png")
    monkeypatch.chdir(place)
    return place


@pytest.fixture
def rdstitch(capsys: pytest.CaptureFixture[str]) -> Run:
    """``rdstitch(*arguments)``: run the command line in this process, and check the exit status.

    ``told`` stands in the one line of a refusal, or in the messages of a success; ``out`` and ``err`` are all that is
    written. None is not checked.
    """

    def call(
        *arguments: object, status: int | None = 0, told: str = "", out: str | None = None, err: str | None = None
    ) -> Outcome:
        capsys.readouterr()
        ended = run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert status in (None, ended), captured.err
        if ended == 0 and "-o" in arguments:
            check_sidecar(Path(f"{arguments[arguments.index('-o') + 1]}.json"))
        done = Outcome.of(ended, captured.out, captured.err)
        assert told in (done.line if ended and told else done.err)
        assert out in (None, done.out)
        assert err in (None, done.err), done.err
        return done

    return call
