"""``--cache``: an interrupted run continues, a changed option repeats only what depends on it, damage does no harm."""

import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rdstitch_cli.main import run

from rdstitch.matching import two_view
from rdstitch.pipeline.registration import detect_features
from rdstitch.verification import overlap_check
from tests.cli.running import FAST, Run, finished, sidecar_of, start
from tests.sampled import sampled


def _result(output: Path) -> tuple[bytes, dict[str, Any]]:
    """The image, and the sidecar apart from the options that say nothing of it."""
    record = sidecar_of(output)
    del record["options"]["cache"], record["options"]["overwrite"]
    return output.read_bytes(), record


@pytest.fixture(scope="session")
def plain(frames: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, dict[str, Any]]:
    """What comes without a cache."""
    output = tmp_path_factory.mktemp("plain") / "out.png"
    assert run(["mosaic", *map(str, frames), "-o", str(output), *FAST]) == 0
    return _result(output)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the expensive functions that were called, in order."""
    called: list[str] = []

    def watch(module: Any, name: str) -> None:
        function: Callable[..., Any] = getattr(module, name)

        def wrapped(*arguments: Any, **options: Any) -> Any:
            called.append(name)
            return function(*arguments, **options)

        monkeypatch.setattr(module, name, wrapped)

    watch(detect_features, "detect_view")
    watch(two_view, "estimate_radial_homographies")
    # The package has a function of the module's name.
    watch(import_module("rdstitch.alignment.recipe"), "_lens_and_model")
    watch(overlap_check, "overlap_agreement")
    return called


def test_only_what_depends_on_a_changed_option_is_done_again(
    rdstitch: Run, frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path, work: list[str]
) -> None:
    output = tmp_path / "out.png"
    arguments = ("mosaic", *frames, "-o", output, "--overwrite", "--cache", tmp_path / "new" / "cache", *FAST)
    everything = {"detect_view", "estimate_radial_homographies", "_lens_and_model", "overlap_agreement"}
    for expected in (everything, set()):
        work.clear()
        first = rdstitch(*arguments)
        assert (first.status, set(work)) == (0, expected)
        assert _result(output) == plain
    for options, expected in (
        (("--blend", "feather", "--scale", "0.5"), set()),
        (("--seed", "1"), {"estimate_radial_homographies", "_lens_and_model", "overlap_agreement"}),
        (("--features", "orb"), everything),
    ):
        work.clear()
        rdstitch(*arguments, *options)
        assert set(work) == expected, options
    # An image that was copied is the same image; one that was changed is another.
    moved = [Path(shutil.copy(frame, tmp_path / f"moved_{frame.name}")) for frame in frames]
    work.clear()
    rdstitch("calibrate", *moved, "-o", tmp_path / "camera.json", *arguments[-2 - len(FAST) :])
    assert work == ["_lens_and_model"]  # whose layout does not matter to a lens


def test_an_image_more_needs_only_its_own(
    rdstitch: Run, frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path, work: list[str]
) -> None:
    cached = ("--cache", tmp_path / "cache", *FAST)
    rdstitch("calibrate", *frames[:2], "-o", tmp_path / "camera.json", *cached)
    work.clear()
    rdstitch("mosaic", *frames, "-o", tmp_path / "out.png", *cached)
    assert work.count("detect_view") == 1
    assert _result(tmp_path / "out.png") == plain


@pytest.mark.parametrize("damage", sampled(["bit turned", "a folder", "cut", "emptied", "replaced by another"], 2))
def test_damaged_entries_are_computed_again(
    rdstitch: Run, frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path, damage: str
) -> None:
    output, cache = tmp_path / "out.png", tmp_path / "cache"
    arguments = ("mosaic", *frames, "-o", output, "--overwrite", "--cache", cache, *FAST)
    rdstitch(*arguments)
    entries = sorted(path for path in cache.rglob("*") if path.is_file())
    assert {path.relative_to(cache).parts[0] for path in entries} >= {"features", "matches", "pairs", "alignment"}
    contents = [entry.read_bytes() for entry in entries]
    for entry, content, other in zip(entries, contents, contents[1:] + contents[:1], strict=True):
        if damage == "a folder":
            entry.unlink()
            entry.mkdir()
            continue
        middle = len(content) // 2
        turned = content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
        entry.write_bytes({"cut": content[:middle], "emptied": b"", "bit turned": turned}.get(damage, other))
    rdstitch(*arguments)
    assert _result(output) == plain
    if damage != "a folder":
        assert [entry.read_bytes() for entry in entries] == contents


def test_damaged_images_are_left_out_every_time(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    bad = tmp_path / "bad.png"
    bad.write_bytes(frames[2].read_bytes()[:-3000])
    arguments = ("mosaic", *frames[:2], bad, "-o", tmp_path / "out.png", "--overwrite", *FAST)
    without = rdstitch(*arguments)
    assert str(bad) in without.line
    for _ in range(2):
        again = rdstitch(*arguments, "--cache", tmp_path / "cache")
        assert (again.status, again.out, again.err) == (without.status, without.out, without.err)


def test_a_cache_that_cannot_be(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    for cache in (tmp_path / "file", tmp_path / "file" / "cache"):
        rdstitch("mosaic", *frames, "-o", tmp_path / "out.png", "--cache", cache, *FAST, status=6, told=str(cache))
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_a_cache_that_is_full_is_no_reason_to_stop(
    rdstitch: Run, frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    cache.mkdir()
    for stage in ("features", "matches", "pairs", "alignment", "overlaps"):
        (cache / stage).write_text("in the way", encoding="utf-8")
    rdstitch("mosaic", *frames, "-o", tmp_path / "out.png", "--cache", cache, *FAST)
    assert _result(tmp_path / "out.png") == plain


def test_killed_runs_continue(
    rdstitch: Run, frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path, work: list[str]
) -> None:
    """Killed while pairs are matched, images aligned, and the output is written; what was done before is not again."""
    output = tmp_path / "out.png"
    arguments: tuple[str | Path, ...] = ("mosaic", *frames, "-o", output, "--cache", tmp_path / "cache", *FAST)
    for stage in ("matching", "aligning", "compositing"):
        process = start(*arguments, "-v")
        while f"{stage} (".encode() not in process.stderr.readline():
            assert process.poll() is None
        process.kill()
        finished(process)
        assert not output.exists()
    rdstitch(*arguments)
    assert work == []
    assert _result(output) == plain


def test_two_processes_share_a_cache(frames: list[Path], plain: tuple[bytes, dict[str, Any]], tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    outputs = [tmp_path / name / "out.png" for name in ("a", "b")]
    running = [start("mosaic", *frames, "-o", output, "--cache", tmp_path / "cache", *FAST) for output in outputs]
    for process, output in zip(running, outputs, strict=True):
        assert finished(process).status == 0
        assert _result(output) == plain
