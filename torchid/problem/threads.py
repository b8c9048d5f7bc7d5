"""One intra-op thread for work on small arrays, and workers that share the chunks of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Task = TypeVar("Task")
Result = TypeVar("Result")


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one intra-op thread.

    A chunk's arrays are too small to split: on a busy two-core machine two threads made evaluation eight times slower.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def worker_count(device: torch.device) -> int:
    """Workers that suit a device: one per thread torch would use on a CPU, one for a GPU."""
    return torch.get_num_threads() if device.type == "cpu" else 1


def share_out(tasks: Sequence[Task], run: Callable[[Sequence[Task]], Result], workers: int) -> list[Result]:
    """Results of `run`, one per worker, each called without gradients on every n-th task."""

    def alone(part: Sequence[Task]) -> Result:
        if workers > 1:
            torch.set_num_threads(1)
        with torch.no_grad():
            return run(part)

    if workers == 1:
        return [alone(tasks)]
    with one_thread(), ThreadPoolExecutor(workers) as pool:
        return list(pool.map(alone, [tasks[i::workers] for i in range(workers)]))
