"""The program of a worker process: tasks come in by standard input and results go out by standard output, pickled."""

import os
import pickle
import threading
import traceback
from queue import SimpleQueue
from typing import IO, Any

from rdstitch.opencv_state import one_opencv_thread
from rdstitch.process_memory import return_freed_memory


def main() -> None:
    """Run tasks until the parent closes the pipe, or is gone; then end at once, in the middle of a task if need be."""
    results = os.fdopen(os.dup(1), "wb")
    # What a library prints must not come among the results.
    os.dup2(2, 1)
    return_freed_memory()
    tasks: SimpleQueue[Any] = SimpleQueue()
    threading.Thread(target=_receive, args=(os.fdopen(os.dup(0), "rb"), tasks), daemon=True).start()
    with one_opencv_thread():
        while True:
            answer = _run(tasks.get())
            results.write(answer)
            results.flush()


def _receive(stream: IO[bytes], tasks: "SimpleQueue[Any]") -> None:
    while True:
        try:
            tasks.put(pickle.load(stream))
        except EOFError:
            os._exit(0)
        except Exception as error:  # noqa: BLE001 - it is the task's failure, and goes where the task came from
            tasks.put(error)


def _run(task: Any) -> bytes:
    try:
        if isinstance(task, Exception):
            raise task
        function, positional, named = task
        return pickle.dumps((True, function(*positional, **named)), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:  # noqa: BLE001 - as above
        error.add_note("in a worker process:\n" + "".join(traceback.format_exception(error)))
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)
        except Exception:  # noqa: BLE001 - an exception may hold anything
            return pickle.dumps((False, RuntimeError("".join(traceback.format_exception(error)))))
        return answer
