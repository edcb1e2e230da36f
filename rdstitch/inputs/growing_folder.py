"""Images of a folder that others write into while it is read."""

import time
from collections.abc import Iterator
from pathlib import Path

from rdstitch.inputs.frame import Frame
from rdstitch.inputs.image_folders import images_in, is_rdstitch_output, natural_key
from rdstitch.system.file_access import file_state

_POLL_SECONDS = 0.2  # between two looks; a file that has not changed for so long is read
_GIVE_UP_SECONDS = 3.0  # after its last change, from which on a file that is not whole is reported

_State = tuple[int, int]  # size and time of the last change


class GrowingFolder:
    """Gives each image once its file no longer changes, until ``idle`` seconds without a new one have passed."""

    def __init__(self, folder: Path, idle: float | None) -> None:
        self._folder, self._idle = folder, idle
        self._done: set[Path] = set()
        self._not_whole: dict[Path, _State] = {}  # files, and the state that they were read at
        # the state of each file at the last look, and since when it has been in it by our clock: the times of files may
        # come from other machines' clocks
        self._seen: dict[Path, tuple[_State, float]] = {}

    def comes_again(self, frame: Frame) -> bool:
        """Whether a frame whose file is not whole will come again, since its file may still be written.

        A file that has not changed for so long that it should be reported comes again only if it changes after all.
        """
        if (state := file_state(frame.path)) is None:
            return False
        self._not_whole[frame.path] = state
        if self._unchanged_for(frame.path, state) > _GIVE_UP_SECONDS:
            return False
        self._done.discard(frame.path)
        return True

    def frames(self) -> Iterator[Frame]:
        """New images, in natural order as far as they come at the same time."""
        last = time.monotonic()
        while True:
            complete, waiting = self._look()
            for path in sorted(complete, key=natural_key):
                self._done.add(path)
                self._not_whole.pop(path, None)
                if not is_rdstitch_output(path):
                    yield Frame(path)
                    last = time.monotonic()
            if not complete:
                if not waiting and self._idle is not None and time.monotonic() - last >= self._idle:
                    return
                time.sleep(_POLL_SECONDS)

    def _look(self) -> tuple[list[Path], bool]:
        """The files that are complete now, and whether others, in which something is already, may become so."""
        complete, waiting = [], False
        for path in images_in(self._folder):
            read_at, done = self._not_whole.get(path), path in self._done
            if done and read_at is None:
                continue
            state = file_state(path)
            if state is None or (done and state == read_at):
                continue
            waiting |= state[0] > 0
            long_enough = _GIVE_UP_SECONDS if state == read_at else _POLL_SECONDS
            if self._unchanged_for(path, state) > long_enough and state[0]:
                complete.append(path)
        return complete, waiting

    def _unchanged_for(self, path: Path, state: _State) -> float:
        """Seconds that a file has been seen in this state."""
        before, since = self._seen.get(path, (None, 0.0))
        now = time.monotonic()
        if state == before:
            return now - since
        self._seen[path] = state, now
        return 0.0
