"""A Dask cluster as an executor: tasks travel through its scheduler, images and features do not."""

import contextlib
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from rdstitch.errors import ArgumentError, LimitError
from rdstitch.system.cache import Cache, software

Given = ParamSpec("Given")
Result = TypeVar("Result")

LOCAL = "local"  # address that stands for a cluster on this machine, started for one run
_PATIENCE, _START = 5, 60  # s, for the scheduler to answer, and for a first worker


class DaskExecutor(Executor):
    """Tasks on the workers of a Dask cluster.

    A worker that dies costs its tasks, which others take over. Leaving the ``with`` block ends what was started for it.
    """

    def __init__(self, address: str, workers: int, store: Path | None) -> None:
        try:
            distributed: Any = import_module("distributed")
        except ImportError as error:
            raise ArgumentError("--scheduler needs Dask: pip install distributed") from error
        self._killed: type[BaseException] = distributed.KilledWorker
        # What matters ends as an exception; a scheduler that goes away would be logged at length.
        logger = logging.getLogger("distributed")
        self._open = contextlib.ExitStack()
        self._open.callback(logger.setLevel, logger.level)
        logger.setLevel(logging.CRITICAL)
        try:
            if address == LOCAL:
                address = self._open.enter_context(
                    distributed.SubprocessCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
                ).scheduler_address
            self._client = self._open.enter_context(
                distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
            )
            self._client.wait_for_workers(1, timeout=_START)
            # Made before the workers look for it.
            self._check_workers(Cache.at(store).folder)
        except (OSError, ValueError) as error:
            self._open.close()
            if isinstance(error, ArgumentError):
                raise
            raise ArgumentError(f"no Dask scheduler with a worker answers at {address}: {error}") from error
        except BaseException:
            self._open.close()
            raise
        self._tasks = self._client.get_executor(pure=False)

    def submit(self, fn: Callable[Given, Result], /, *args: Given.args, **kwargs: Given.kwargs) -> Future[Result]:
        """See :meth:`concurrent.futures.Executor.submit`; function and arguments are pickled."""
        future: Future[Result] = self._tasks.submit(fn, *args, **kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        if wait or cancel_futures:
            self._tasks.shutdown(wait=not cancel_futures)
            self._open.close()
        else:  # the client is closed when its tasks have ended
            threading.Thread(target=self.shutdown).start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Leave the cluster; tasks under way are cancelled after an exception."""
        self.shutdown(cancel_futures=error is not None)
        if isinstance(error, self._killed):
            raise LimitError(
                "several workers of the cluster died at the same task (no memory left?); give them more memory"
            ) from error

    def _check_workers(self, store: Path | None) -> None:
        """Refuse workers whose results would be others, or that could not hand them over."""
        try:
            of_workers: dict[str, tuple[bool, dict[str, str]]] = self._client.run(_describe_worker, store)
        except ImportError as error:
            raise ArgumentError(f"a worker of the cluster has no rdstitch: {error}") from error
        for worker, (sees_store, versions) in sorted(of_workers.items()):
            if not sees_store:
                raise ArgumentError(
                    f"{store}: the worker {worker} does not see this folder; give --cache a folder that all "
                    "machines share by the same name"
                )
            others = sorted(name for name, version in software().items() if versions.get(name) != version)
            if others:
                raise ArgumentError(
                    f"the worker {worker} has another version of {', '.join(others)} than this machine; install the "
                    "same"
                )


def _describe_worker(store: Path | None) -> tuple[bool, dict[str, Any]]:
    """Whether a worker sees the store, and what it computes with."""
    return store is None or store.is_dir(), software()
