"""One intra-op thread for work on small arrays, and workers that share the chunks of a log."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController

Task = TypeVar("Task")
Result = TypeVar("Result")


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one intra-op thread, of torch and of NumPy's linear algebra.

    These arrays are too small to split: on a busy two-core machine two threads made evaluation eight times slower, and
    a consistent estimate three times.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _pools().limit(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


@cache
def _pools() -> ThreadpoolController:
    return ThreadpoolController()


def worker_count(device: torch.device) -> int:
    """Workers that suit a device: one per thread torch would use on a CPU, one for a GPU."""
    return torch.get_num_threads() if device.type == "cpu" else 1


def share_out(tasks: Sequence[Task], run: Callable[[Iterator[Task]], Result], workers: int) -> list[Result]:
    """Results of `run`, one per worker, each called without gradients on every n-th task.

    A failure or an interrupt stops all workers at their next task.
    """
    stop = threading.Event()

    def alone(first: int) -> Result:
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

    with one_thread():
        if workers == 1:
            return [alone(0)]
        with ThreadPoolExecutor(workers) as pool, stopping():
            return list(pool.map(alone, range(workers)))
