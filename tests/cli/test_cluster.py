"""``--scheduler``: a Dask cluster gives the same bytes, also when a worker dies; what cannot work is said in a line."""

import json
import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import rdstitch
from rdstitch.compositing.tiles import TiledOutput
from rdstitch.executors import ProcessExecutor
from rdstitch.pipeline.run_on_sources import _result_and_state
from tests.cli.running import FAST, Run, flight, sidecar_of

pytest.importorskip("distributed")

_IMAGES = 8  # each a task


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return flight(4, _IMAGES).write(tmp_path_factory.mktemp("strip"))


@contextmanager
def _cluster(folder: Path, workers: int) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"]]]:
    """Address of a scheduler on loopback, and its worker processes, which nothing starts again."""
    place, log = folder / "scheduler.json", (folder / "log").open("wb")
    options = ("--scheduler-file", str(place), "--no-dashboard")

    def start(*arguments: str) -> "subprocess.Popen[bytes]":
        return subprocess.Popen([sys.executable, "-m", "dask", *arguments, *options], stdout=log, stderr=log)

    started = [start("scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        until = time.monotonic() + 60
        while not place.exists():
            assert time.monotonic() < until
            time.sleep(0.05)
        once = ("--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", "--local-directory", str(folder))
        started += [start("worker", *once) for _ in range(workers)]
        yield json.loads(place.read_text(encoding="utf-8"))["address"], started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()
        log.close()


def _record(output: Path) -> dict[str, Any]:
    record: dict[str, Any] = sidecar_of(output)
    for name in ("cache", "scheduler", "workers"):
        del record["options"][name]
    return record


def test_same_bytes_though_a_worker_dies(images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    features = rdstitch.FeatureOptions(max_features=600)
    here, there = tmp_path / "here" / "out.png", tmp_path / "there" / "out.png"
    here.parent.mkdir()
    there.parent.mkdir()
    rdstitch.mosaic(images, here, rdstitch.StitchOptions(features=features, workers=1))
    monkeypatch.setattr(TiledOutput, "strips", lambda *_: pytest.fail("pixels are for the workers, in this process"))
    with _cluster(tmp_path, 2) as (address, workers):
        steps: list[tuple[str, int]] = []

        def kill_one(stage: str, done: int, total: int) -> None:
            steps.append((stage, done))
            if stage == "detecting features" and 2 <= done < total:
                workers[0].kill()

        options = rdstitch.StitchOptions(features=features, cache=tmp_path / "store", scheduler=address)
        rdstitch.mosaic(images, there, options, progress=kill_one)
        assert workers[0].wait(10) != 0
        assert workers[1].poll() is None
    assert there.read_bytes() == here.read_bytes()
    assert _record(there) == _record(here)
    assert not list((tmp_path / "store").glob("rdstitch-*")), "what the workers had composed is removed"
    assert [done for stage, done in steps if stage == "detecting features"] == list(range(1, _IMAGES + 1))


@pytest.mark.slow
def test_same_bytes_of_one_and_four_workers(
    images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All work on images and pairs is in tasks: each kind of them was handed over."""
    handed: set[str] = set()

    class Recording(ProcessExecutor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            work = args[0][0] if fn is _result_and_state else fn
            handed.add(getattr(work, "func", work).__name__)
            return super().submit(fn, *args, **kwargs)

    monkeypatch.setattr("rdstitch.pipeline.run.open_executor", lambda workers, *_, **__: Recording(workers))
    outputs = []
    for workers in (1, 4):
        outputs.append(tmp_path / str(workers) / "out.png")
        outputs[-1].parent.mkdir()
        features = rdstitch.FeatureOptions(max_features=600)
        rdstitch.mosaic(images, outputs[-1], rdstitch.StitchOptions(features=features, workers=workers))
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    assert _record(outputs[0]) == _record(outputs[1])
    assert handed == {"_grey_of", "detect_batch", "match_pairs", "estimate_pairs", "compose_block"}


def test_a_cluster_is_started_here_and_ended(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    plain, done = (
        rdstitch("mosaic", *frames, "-o", tmp_path / f"{name}.png", *FAST, *more)
        for name, more in (("plain", ()), ("local", ("--scheduler", "local")))
    )
    assert (done.status, done.out, done.err) == (0, plain.out, "")
    assert (tmp_path / "local.png").read_bytes() == (tmp_path / "plain.png").read_bytes()


def test_what_a_cluster_lacks_is_said(rdstitch: Run, frames: list[Path], tmp_path: Path) -> None:
    arguments = ("mosaic", *frames, "-o", tmp_path / "out.png", *FAST, "--scheduler", "tcp://127.0.0.1:9")
    level = logging.getLogger("distributed").level
    rdstitch(*arguments, status=2, told="--cache")
    nobody = rdstitch(*arguments, "--cache", tmp_path / "cache", status=2, told="no Dask scheduler")
    assert "tcp://127.0.0.1:9" in nobody.line
    assert logging.getLogger("distributed").level == level
    assert not (tmp_path / "out.png").exists()
