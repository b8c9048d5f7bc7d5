"""Logs in chunks of samples that share a contact state, and workers that go over them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import torch

from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.threads import share_out, worker_count

CHUNK = 2048
"""Samples per chunk: fewer lose to dispatch, more to memory traffic (measured on CPU)."""

Progress = Callable[[int], None]
Result = TypeVar("Result")


def by_state(samples: Samples, chunk: int = CHUNK) -> Iterator[tuple[State, slice | torch.Tensor]]:
    """Chunks of samples that share a contact state: the state and an index into the samples."""
    active = samples.active.cpu().numpy()
    packed = np.packbits(active, axis=1) if active.shape[1] else np.zeros((len(active), 1), np.uint8)
    keys = packed.view(f"V{packed.shape[1]}")[:, 0]
    found, first = np.unique(keys, return_index=True)
    for key, example in zip(found, first, strict=True):
        if len(found) == 1:
            pieces: Iterable[slice | torch.Tensor] = (slice(i, i + chunk) for i in range(0, len(active), chunk))
        else:
            pieces = torch.from_numpy(np.flatnonzero(keys == key)).split(chunk)
        for piece in pieces:
            yield tuple(active[example].tolist()), piece


def spread_by_state(logs: Sequence[Samples], count: int) -> Iterator[tuple[Samples, State, float]]:
    """About `count` samples of every contact state, evenly spread over the logs, and how many each stands for."""
    found: dict[State, list[tuple[Samples, torch.Tensor]]] = {}
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in by_state(samples):
            found.setdefault(state, []).append((samples, every[index]))
    for state, pieces in found.items():
        total = sum(len(index) for _, index in pieces)
        for samples, index in pieces:
            share = min(len(index), max(1, round(count * len(index) / total)))
            yield samples[index[torch.linspace(0, len(index) - 1, share).long()]], state, len(index) / share


def over_chunks(
    logs: Sequence[Samples],
    builder: RowBuilder,
    fold: Callable[[Iterator[tuple[Samples, State]]], Result],
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """What `fold` makes of the chunks of some logs, one result per worker.

    Args:
        logs: bound logs; each is moved to the builder's device chunk by chunk.
        builder: whose plans and device are used.
        fold: given an iterator over some of the chunks and their contact states.
        chunk: samples per chunk.
        threads: workers, each with one intra-op thread (small arrays do not profit from more); by default one per
            intra-op thread torch would use, one if the builder is on a GPU.
        progress: called with the number of samples done since the last call.
    """
    tasks = [(samples, state, index) for samples in logs for state, index in by_state(samples, chunk)]
    for _, state, _ in tasks:
        builder.plan(state)
    lock = threading.Lock()

    def run(part: Iterator[tuple[Samples, State, slice | torch.Tensor]]) -> Result:
        return fold(pieces(part))

    def pieces(part: Iterator[tuple[Samples, State, slice | torch.Tensor]]) -> Iterator[tuple[Samples, State]]:
        for samples, state, index in part:
            piece = samples[index].to(builder.device)
            yield piece, state
            if progress is not None:
                with lock:
                    progress(len(piece))

    return share_out(tasks, run, threads or worker_count(builder.device))
