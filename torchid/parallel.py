"""Threads of this process, and forks of it (fork(2)), which share work between the cores of one machine.

A fork needs no imports and no copied arguments. A program that uses torchid as a library may have threads, which a fork
lacks, so only the command line allows forks. Processes that share the work of a run (`torchid.distributed`) have no
forks, and can replace them. torch is imported only where it is used, because commands start without it.
"""

from __future__ import annotations

import gc
import multiprocessing
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Generic, TypeVar

from torchid import distributed
from torchid.staging import interrupts_deferred

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

T = TypeVar("T")
Item = TypeVar("Item")


def thread_count() -> int:
    """Number of threads that torch uses for one operation, outside of `one_thread`."""
    import torch

    return torch.get_num_threads() if _outside is None else _outside


_outside: int | None = None  # `thread_count` while a block runs with one thread


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one intra-op thread of torch and of NumPy's linear algebra.

    The arrays are too small to split. On a busy two-core machine two threads made evaluation eight times slower, a
    consistent estimate three times, and the QR decomposition of 275 rows of 157 columns twenty times.
    """
    import torch

    global _outside
    before = torch.get_num_threads()
    outermost = _outside is None
    torch.set_num_threads(1)
    try:
        if outermost:
            _outside = before
            with _pools().limit(limits=1, user_api="blas"):
                yield
        else:
            yield
    finally:
        if outermost:
            _outside = None
        torch.set_num_threads(before)


@cache
def _pools() -> ThreadpoolController:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def run_in_workers(tasks: Sequence[Item], run: Callable[[Iterator[Item]], T], workers: int) -> list[T]:
    """Results of `run`, one per worker; each gets every n-th task, without gradients. No worker is without a task.

    A failure or an interrupt stops all workers at their next task.
    """
    import torch

    stop = threading.Event()

    def work(first: int) -> T:
        torch.set_num_threads(1)
        with torch.no_grad(), stopping():
            return run(task for task in tasks[first::workers] if not stop.is_set())

    @contextmanager
    def stopping() -> Iterator[None]:
        try:
            yield
        except BaseException:
            stop.set()
            raise

    workers = min(workers, max(len(tasks), 1))
    with one_thread():
        if workers == 1:
            return [work(0)]
        with ThreadPoolExecutor(workers) as pool, stopping():
            return list(pool.map(work, range(workers)))


def map_in_workers(tasks: Sequence[Item], work: Callable[[Item], T], workers: int | None = None) -> list[T]:
    """Apply a function to each task, in order, in threads (by default `thread_count`)."""
    parts = run_in_workers(tasks, lambda share: [work(task) for task in share], workers or thread_count())
    return [parts[number % len(parts)][number // len(parts)] for number in range(len(tasks))]


_allowed = False


@contextmanager
def forks_allowed() -> Iterator[None]:
    """Allow functions inside the block to fork this process, on systems where that is safe."""
    global _allowed
    _allowed = sys.platform == "linux"  # libraries of macOS fail in forks, Windows has none
    try:
        yield
    finally:
        _allowed = False


def can_fork() -> bool:
    """Whether this process may fork now."""
    # torchrun has started processes for all cores
    return _allowed and not _uses_a_gpu() and not distributed.is_launched()


class Fork(Generic[T]):
    """A fork of this process that calls a function; it ends with the `with` block.

    If forks are not allowed, or the fork meets a warning or an error or dies, this process calls the function itself
    when it needs the result. So all warnings and errors come from this process.
    """

    def __init__(self, work: Callable[[], T]) -> None:
        """Start it; `work`: the function. Its result must pickle."""
        self._work = work
        self._process: multiprocessing.context.ForkProcess | None = None
        self._results: Connection | None = None

    def __enter__(self) -> Fork[T]:
        if can_fork():
            try:
                self._start()
            except BaseException:  # Ctrl-C meanwhile: the fork would go on writing files
                self.__exit__()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.pid is not None:
            self._process.kill()
            self._process.join()
        if self._results is not None:
            self._results.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("fork")
        with interrupts_deferred(), suppress(OSError):  # no memory, or too many processes
            self._results, sender = context.Pipe(duplex=False)
            with sender, warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: of threads that a fork lacks
                self._process = context.Process(target=_call, args=(self._work, self._results, sender), daemon=True)
                self._process.start()

    def result(self) -> T:
        """The result of the function; raises its error."""
        if self._results is not None:
            with suppress(EOFError, OSError, pickle.UnpicklingError):
                results: tuple[T, ...] = pickle.loads(self._results.recv_bytes())
                if results:
                    return results[0]
        return self._work()


def share_between_forks(items: Sequence[Item], work: Callable[[Item], T], count: int) -> list[T]:
    """Apply a function to items, in order; this process works on some, its forks on the others.

    Args:
        items: with about the same amount of work each.
        work: the function; its result must pickle.
        count: number of processes, with this one.
    """
    count = max(min(count, len(items)), 1)

    def share(first: int) -> list[T]:
        return [work(item) for item in items[first::count]]

    with ExitStack() as stack:
        forks = [stack.enter_context(Fork(partial(share, first))) for first in range(1, count)]
        shares = [share(0), *(fork.result() for fork in forks)]
    return [shares[number % count][number // count] for number in range(len(items))]


def share_between_processes(items: Sequence[Item], work: Callable[[Item], T], count: int) -> list[T]:
    """As `share_between_forks`, but between the processes that share the work of a run; all must call it.

    If an item gives a warning or an error in one of them, the first process repeats it and reports.
    """
    if distributed.world_size() == 1:
        return share_between_forks(items, work, count)
    share = range(distributed.rank(), len(items), distributed.world_size())
    with distributed.apart():
        attempts = {number: _attempt(partial(work, items[number])) for number in share}
    outcomes = {
        number: outcome
        for of_process in distributed.all_gather(attempts, "shares")
        for number, outcome in of_process.items()
    }
    return [
        outcomes[number][0] if outcomes[number] else distributed.from_first(partial(work, item), "a share")
        for number, item in enumerate(items)
    ]


def _attempt(work: Callable[[], T]) -> tuple[T, ...]:
    """The result of a function in a tuple; an empty tuple if it gives a warning or an error."""
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        return (work(),)
    return ()


def _uses_a_gpu() -> bool:
    """Whether this process uses a GPU, which a fork cannot use."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.cuda.is_initialized()


def _call(work: Callable[[], T], results: Connection, sender: Connection) -> None:
    """Send the result of a function, or that it gave a warning or an error."""
    global _allowed
    _allowed = False
    gc.freeze()  # to look for garbage among what the original has would copy all of it
    results.close()  # so that sending fails once the original has gone
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that waits, which ends this one
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)  # threads of the original are not there
    outcome = _attempt(work)
    with suppress(Exception):
        sender.send_bytes(pickle.dumps(outcome))  # `send` would leave tensors behind in this process
