"""Threads of this process, and forks of it, copies by fork(2), that share work between the cores of one machine.

Nothing has to be imported by a fork, or handed over to it. Whoever calls torchid as a library may have threads that a
fork lacks: only the command line allows forks. Processes that share the work of a run (`torchid.distributed`) have no
forks; they can take the part of these. torch is loaded where it is used, as commands begin without it.
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
    """Threads that torch would use for one operation, outside of `one_thread`."""
    import torch

    return torch.get_num_threads() if _outside is None else _outside


_outside: int | None = None  # `thread_count` while a block runs with one thread


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one intra-op thread, of torch and of NumPy's linear algebra.

    These arrays are too small to split: on a busy two-core machine two threads made evaluation eight times slower, a
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
    """Results of `run`, one per worker, each called without gradients on every n-th task; no worker is without one.

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
    """What a function makes of each task, in their order, by threads: by default as many as `thread_count`."""
    parts = run_in_workers(tasks, lambda share: [work(task) for task in share], workers or thread_count())
    return [parts[number % len(parts)][number // len(parts)] for number in range(len(tasks))]


_allowed = False


@contextmanager
def forks_allowed() -> Iterator[None]:
    """Let functions within the block be called by forks of this process, on systems where that is safe."""
    global _allowed
    _allowed = sys.platform == "linux"  # libraries of macOS fail in forks, Windows has none
    try:
        yield
    finally:
        _allowed = False


def can_fork() -> bool:
    """Whether forks of this process may be made now."""
    # torchrun has started processes for all cores
    return _allowed and not _uses_a_gpu() and not distributed.is_launched()


class Fork(Generic[T]):
    """A fork of this process that calls a function, in a `with` block at whose end it is gone.

    Where forks are not allowed, or the fork meets a warning, an error or its end, this process calls the function
    itself when it needs the result: it says whatever there is to say.
    """

    def __init__(self, work: Callable[[], T]) -> None:
        """Start it; `work`: what it calls; the result pickles."""
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
        """What the function returns, or raises."""
        if self._results is not None:
            with suppress(EOFError, OSError, pickle.UnpicklingError):
                results: tuple[T, ...] = pickle.loads(self._results.recv_bytes())
                if results:
                    return results[0]
        return self._work()


def share_between_forks(items: Sequence[Item], work: Callable[[Item], T], count: int) -> list[T]:
    """What a function makes of each of some items, in their order; this process works on some, its forks on others.

    Args:
        items: about the same work each.
        work: a function of one; its result pickles.
        count: of processes, this one included.
    """
    count = max(min(count, len(items)), 1)

    def share(first: int) -> list[T]:
        return [work(item) for item in items[first::count]]

    with ExitStack() as stack:
        forks = [stack.enter_context(Fork(partial(share, first))) for first in range(1, count)]
        shares = [share(0), *(fork.result() for fork in forks)]
    return [shares[number % count][number // count] for number in range(len(items))]


def share_between_processes(items: Sequence[Item], work: Callable[[Item], T], count: int) -> list[T]:
    """As `share_between_forks`; processes that share the work of a run, which all call this, are the forks.

    What meets a warning or an error in one of them the first one does again, which alone says things.
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
    """What a function returns, alone in a tuple; an empty one where it meets a warning or an error."""
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        return (work(),)
    return ()


def _uses_a_gpu() -> bool:
    """Whether this process has a connection to a GPU, which a fork cannot use."""
    torch = sys.modules.get("torch")
    return torch is not None and torch.cuda.is_initialized()


def _call(work: Callable[[], T], results: Connection, sender: Connection) -> None:
    """Send what a function returns, or that it did not without a warning."""
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
