"""Recipes work on images side by side, so that libraries below Python get one thread each, and theirs back after it."""

import os
import subprocess
import sys

import pytest

_RECIPE = """
import cv2
import numpy as np
import rdstitch
from rdstitch.system.native_threads import _openblas, one_native_thread

state = _openblas()
if state is None:
    raise SystemExit(77)
threads = state.read
before, during = threads(), set()
scene = cv2.resize(np.random.default_rng(0).integers(0, 255, (30, 50), dtype=np.uint8), (150, 90))
how = rdstitch.StitchOptions(distortion=0.0, focal=100.0, force=True, workers=2)
images = [scene[:, :100].copy(), scene[:, 50:].copy()]
rdstitch.pano(images, options=how, progress=lambda *_: during.add(threads()))
assert (before, during, threads()) == (2, {1}, 2), (before, during, threads())

first, second = one_native_thread(), one_native_thread()  # as of two threads of a host
first.__enter__()
second.__enter__()
first.__exit__(None, None, None)
assert threads() == 1
second.__exit__(None, None, None)
assert threads() == 2
"""


def test_a_recipe_keeps_blas_to_one_thread() -> None:
    # OpenBLAS starts no more threads than it has processors.
    if (os.cpu_count() or 1) < 2:
        pytest.skip("one processor")
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", _RECIPE], env=environment, timeout=120, check=False)
    if done.returncode == 77:
        pytest.skip("NumPy has another BLAS here")
    assert done.returncode == 0
