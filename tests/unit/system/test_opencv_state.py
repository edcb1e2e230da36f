"""OpenCV's threads and log level are as they were, whatever happened meanwhile."""

import os
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

import cv2
import pytest

from rdstitch.io.video import opened_capture
from rdstitch.system.native_threads import one_opencv_thread, silent_opencv

LOGGING: Any = getattr(cv2.utils, "logging", cv2)
THREADS = (one_opencv_thread, cv2.getNumThreads, cv2.setNumThreads, 1)
LEVEL = (silent_opencv, LOGGING.getLogLevel, LOGGING.setLogLevel, 0)


@pytest.mark.parametrize("level", [None, "16"])
def test_a_video_leaves_the_environment_as_it_was(monkeypatch: pytest.MonkeyPatch, level: str | None) -> None:
    monkeypatch.delenv("OPENCV_FFMPEG_LOGLEVEL", raising=False)
    if level is not None:
        monkeypatch.setenv("OPENCV_FFMPEG_LOGLEVEL", level)
    before = dict(os.environ)
    with opened_capture("nothing.mp4"):
        pass
    assert dict(os.environ) == before


@pytest.mark.parametrize("state", [THREADS, LEVEL], ids=["threads", "log level"])
def test_the_last_to_leave_gives_back_what_was(state: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # the test runner has threads of its own
    changed, current, put, inside = state
    before = current()
    first, second = changed(), changed()
    try:
        put(3)
        first.__enter__()
        second.__enter__()
        second.__exit__(None, None, None)
        assert current() == inside
        first.__exit__(None, None, None)
        assert current() == 3
        with suppress(ZeroDivisionError), changed():
            current(1 // 0)
        assert current() == 3
    finally:
        put(before)


_BESIDE_THREADS_OF_A_HOST = """
import threading
import cv2
import numpy as np
import rdstitch

switch, switched = cv2.setNumThreads, []
switch(4)
cv2.setNumThreads = lambda count: (switched.append(count), switch(count))
scene = cv2.resize(np.random.default_rng(0).integers(0, 255, (30, 50), dtype=np.uint8), (150, 90))
images = [scene[:, :100].copy(), scene[:, 50:].copy()]
how = rdstitch.StitchOptions(distortion=0.0, focal=100.0, force=True, workers=2)
done = threading.Event()

def smooth():
    while not done.is_set():
        cv2.GaussianBlur(np.zeros((300, 400, 3), np.uint8), (9, 9), 0)

threads = [threading.Thread(target=smooth) for _ in range(3)]
[thread.start() for thread in threads]
for _ in range(2):
    rdstitch.pano(images, options=how)
done.set()
assert not switched
"""


def test_threads_of_the_host_go_on_inside_opencv() -> None:
    # To switch OpenCV's threads would end the process: a division by their number.
    done = subprocess.run([sys.executable, "-c", _BESIDE_THREADS_OF_A_HOST], timeout=120, check=False)
    assert done.returncode == 0


_BESIDE_A_THREAD_STARTED_MEANWHILE = """
import sys, threading, time
from concurrent.futures import ThreadPoolExecutor
import cv2
from rdstitch.system.native_threads import one_opencv_thread

cv2.setNumThreads(4)
done, pool = threading.Event(), ThreadPoolExecutor(1)
with one_opencv_thread():
    inside = cv2.getNumThreads()
    work = {"waits": done.wait, "works": lambda: [time.sleep(0.001) for _ in iter(done.is_set, True)]}[sys.argv[1]]
    threading.Thread(target=work).start()
    pool.submit(int).result()
    time.sleep(0.1)
print(inside, cv2.getNumThreads())
done.set()
"""


@pytest.mark.parametrize(("thread", "after"), [("waits", 4), ("works", 1)])
def test_threads_come_back_where_those_started_meanwhile_only_wait(thread: str, after: int) -> None:
    # A progress bar's monitor lives on for ever; one that works may be inside OpenCV.
    script = [sys.executable, "-c", _BESIDE_A_THREAD_STARTED_MEANWHILE, thread]
    done = subprocess.run(script, timeout=120, check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["1", str(after)]


_IN_A_FORKED_CHILD = """
import os, sys
import cv2
import numpy as np
from rdstitch.features.detect import detect
from rdstitch.io.video import opened_capture
from rdstitch.system.native_threads import one_opencv_thread

image = np.random.default_rng(0).integers(0, 255, (400, 600), dtype=np.uint8)
cv2.setNumThreads(4)
cv2.GaussianBlur(np.tile(image, (5, 5)).astype(np.float32), (0, 0), 3.0)
cv2.setNumThreads(int(sys.argv[1]))
before = cv2.getNumThreads()
if (child := os.fork()) == 0:
    with one_opencv_thread():
        inside = cv2.getNumThreads()
        found = len(detect(image).points)
    os._exit(0 if (inside, cv2.getNumThreads()) == (1, before) and found else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.parametrize("threads", ["4", "0"])
def test_a_forked_process_does_not_wait_for_the_threads_of_its_parent(threads: str) -> None:
    # It would wait for ever; the limit is for the test to end.
    done = subprocess.run([sys.executable, "-c", _IN_A_FORKED_CHILD, threads], timeout=120, check=False)
    assert done.returncode == 0


def test_a_private_name_of_python_is_not_needed() -> None:
    script = "import concurrent.futures.thread as t; del t._worker; import rdstitch.system.native_threads"
    subprocess.run([sys.executable, "-c", script], timeout=60, check=True)
