"""Logs in chunks of samples that share a contact state, copied to the device, and workers that process them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from typing import TypeVar

import numpy as np
import torch

from torchid import distributed, kernels
from torchid.errors import warn
from torchid.parallel import run_in_workers, thread_count
from torchid.problem.compiled_rows import CompiledRows
from torchid.problem.contact_state import ContactState
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, concatenate

Item = TypeVar("Item")
Label = TypeVar("Label")
Result = TypeVar("Result")

ProgressCallback = Callable[[int], None]
"""Called with the number of samples, or of other steps, done since the last call."""

CHUNK = 4096
"""Samples per chunk: fewer cost overhead and waits for Python's lock, more cost memory traffic."""

_LEAST = 2048  # samples per chunk where there are fewer than `_EACH` chunks for each worker
_EACH = 4
_LET_GO = 4  # chunks of a worker, after which it releases the mapped pages of the samples
_MANY = 200_000  # samples, for which kernels save a second
_MOST_ON_GPU = 64 * CHUNK  # samples per chunk: a launch takes the host 12 ms for any size
_SHARE_OF_GPU = 8  # a chunk takes at most this fraction (1 / 8) of a GPU's memory
_ON_GPU = 48 * 2**10  # bytes of a sample


def map_chunks(
    logs: Sequence[Samples],
    builder: RowBuilder,
    reduce: Callable[[Iterator[tuple[Samples, ContactState]]], Result],
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> list[Result]:
    """Apply `reduce` to the chunks of logs; one result per worker.

    Processes that share their work (`torchid.distributed`) take successive chunks; all get the results of all.

    Args:
        logs: each is moved to the builder's device chunk by chunk, see `upload`.
        builder: with layouts and device.
        reduce: takes an iterator over chunks and their contact states; its result must pickle.
        chunk: samples per chunk; by default `chunk_size` of the builder's device.
        threads: workers, each with one intra-op thread (small arrays do not profit from more); by default one per
            intra-op thread of torch, or one on a GPU.
        progress: called with the number of samples done since the last call.
    """
    workers = threads or worker_count(builder.device)
    size = chunk or chunk_size(builder.device)
    sharing = distributed.broadcast(workers, "workers")
    if chunk is None and sharing > 1:
        size = min(size, max(sum(map(len, logs)) // (_EACH * sharing), _LEAST))
    tasks = _chunks(logs, size, sharing)
    for task in tasks:
        builder.layout(task.state, task.parts[0][0].contact_normal is not None)
    sizes = [len(task) for task in tasks]
    choose_kernels(builder, sum(sizes))
    distributed.require_same(hash(tuple(zip(sizes, (task.state for task in tasks), strict=True))), "logs")
    share = distributed.own_share(sizes)
    tasks_here = tasks[share]
    report = None if progress is None else _ProgressOfAll(progress, sum(sizes), sum(sizes[share]))

    def run(part: Iterator[_Chunk]) -> Result:
        return reduce(_pieces(part, builder.device, report))

    results = run_in_workers(tasks_here, run, workers)
    if report is not None:
        report(0)
    return list(chain.from_iterable(distributed.all_gather(results, "chunks")))


def choose_kernels(builder: RowBuilder, samples: int) -> None:
    """Let a builder use compiled kernels where they are available; otherwise torch.

    Torch handles extra parameters of contact sensors, and task weights.

    Warns:
        TorchidWarning: The kernels are missing, and so many samples would be faster with them.
    """
    plain = builder.device.type == "cpu" and builder.tree.ancestors.dtype == torch.float64
    plain = plain and builder.task_weights is None and not any(extra.contacts for extra in builder.extras)
    if plain and kernels.compiled() is None and samples >= _MANY:
        warn(f"compression takes twice as long: {kernels.why_not_compiled()}")
    if not plain or kernels.compiled() is None:
        builder.compiled = None
    elif builder.compiled is None:
        builder.compiled = CompiledRows(builder)


def _pieces(
    tasks: Iterator[_Chunk], device: torch.device, report: ProgressCallback | None
) -> Iterator[tuple[Samples, ContactState]]:
    """The samples of some chunks on a device; says how many of them are done."""

    def chosen() -> Iterator[tuple[Samples, ContactState]]:
        for number, task in enumerate(tasks, start=1):
            yield join_pieces([samples[index] for samples, index in task.parts]), task.state
            pages = task.parts[0][0].pages
            if pages is not None and number % _LET_GO == 0:
                pages.release()

    for piece, state in upload(chosen(), device):
        yield piece, state
        if report is not None:
            report(len(piece))


class _ProgressOfAll:
    """Reports samples as if all processes were as far as this one; the callback need not be thread-safe."""

    def __init__(self, progress: ProgressCallback, total: int, share: int) -> None:
        self._progress = progress
        self._total = total
        self._own = share
        self._lock = threading.Lock()
        self._done = 0
        self._reported = 0

    def __call__(self, samples: int) -> None:
        """Add samples that this process has done; 0 at the end of the pass."""
        with self._lock:
            self._done += samples
            reached = self._total * self._done // self._own if self._own else self._total
            if reached > self._reported:
                self._progress(reached - self._reported)
                self._reported = reached


@dataclass(frozen=True)
class _Chunk:
    """Samples of one contact state and log: its pieces, and the numbers of their samples."""

    state: ContactState
    parts: list[tuple[Samples, slice | torch.Tensor]]

    def __len__(self) -> int:
        return sum(_size(samples, index) for samples, index in self.parts)


def _size(samples: Samples, index: slice | torch.Tensor) -> int:
    return len(range(*index.indices(len(samples)))) if isinstance(index, slice) else len(index)


def _chunks(logs: Sequence[Samples], size: int, workers: int) -> list[_Chunk]:
    """Chunks of limited size; small ones of one log are joined, because any chunk takes milliseconds."""
    out: list[_Chunk] = []
    last: dict[tuple[str, ContactState], _Chunk] = {}
    for samples in logs:
        for state, index in chunks_by_state(samples, size, workers):
            before = last.get((samples.source, state))
            fits = before is not None and len(before) + _size(samples, index) <= size
            if before is not None and fits and are_of_one_log(before.parts[0][0], samples):
                before.parts.append((samples, index))
            else:
                out.append(_Chunk(state, [(samples, index)]))
                last[samples.source, state] = out[-1]
    return out


def are_of_one_log(piece: Samples, other: Samples) -> bool:
    """Whether two pieces differ only in samples, folds and blocks, and have no readings in the air.

    Readings in the air have separate equations for each fold and chunk.
    """
    if piece.unloaded is not None or other.unloaded is not None:
        return False
    fields, other_fields = (
        {name: x for name, x in (vars(log) | vars(log.base)).items() if name not in ("base", "fold", "blocks")}
        for log in (piece, other)
    )
    return all(
        x is other_fields[name] or isinstance(x, torch.Tensor) is isinstance(other_fields[name], torch.Tensor) is True
        for name, x in fields.items()
    )


def join_pieces(pieces: Sequence[Samples]) -> Samples:
    """Pieces of one log as one, which has the fold and block of each sample."""
    if len(pieces) == 1:
        return pieces[0]
    numbers = [
        torch.tensor([[piece.fold, 0]]).expand(len(piece), 2) if piece.blocks is None else piece.blocks
        for piece in pieces
    ]
    return replace(concatenate([replace(piece, blocks=None) for piece in pieces]), blocks=torch.cat(numbers))


def blocks_in(samples: Samples) -> list[tuple[int, int, int, int]]:
    """Fold, number, first sample and end of the blocks that a chunk has samples of."""
    if samples.blocks is None:
        return [(samples.fold, 0, 0, len(samples))]
    numbers, counts = torch.unique_consecutive(samples.blocks, return_counts=True, dim=0)
    ends = counts.cumsum(0).tolist()
    spans = zip(numbers.tolist(), [0, *ends[:-1]], ends, strict=True)
    return [(fold, number, start, end) for (fold, number), start, end in spans]


def span_of_samples(index: torch.Tensor | slice, start: int, end: int) -> tuple[int, int]:
    """Which of the samples of some rows, all or some of those of a chunk, lie between two of the chunk."""
    if isinstance(index, torch.Tensor):  # of samples whose contacts have one rank
        start, end = torch.searchsorted(index, torch.tensor([start, end]).to(index)).tolist()
    return start, end


def chunks_by_state(
    samples: Samples, chunk: int = CHUNK, workers: int = 1
) -> Iterator[tuple[ContactState, slice | torch.Tensor]]:
    """Chunks of samples that share a contact state, of about equal size: the state and an index into the samples.

    Args:
        samples: of one log.
        chunk: largest number of samples per chunk.
        workers: each gets the same number of chunks of a state, unless there is only one.
    """
    active = samples.active.cpu().numpy()
    starts, state_of_run = _runs(active)
    lengths = np.diff(starts, append=len(active))
    for number in range(state_of_run.max(initial=-1) + 1):
        in_state = state_of_run == number
        count = -(-int(lengths[in_state].sum()) // chunk)
        if count > 1:
            count = -(-count // workers) * workers
        if in_state.all():
            ends = np.linspace(0, len(active), count + 1).astype(int).tolist()
            pieces: Iterable[slice | torch.Tensor] = (slice(*pair) for pair in pairwise(ends))
        else:
            pieces = torch.from_numpy(np.flatnonzero(np.repeat(in_state, lengths))).tensor_split(count)
        state = tuple(active[starts[np.argmax(in_state)]].tolist())
        for piece in pieces:
            yield state, piece


def _runs(active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where contacts (N, C) change, the first sample included, and the number of the contact state from there on.

    Few are sorted in place of all samples, of which a log may have millions.
    """
    packed = np.packbits(active, axis=1) if active.shape[1] else np.zeros((len(active), 1), np.uint8)
    changes = np.flatnonzero((packed[1:] != packed[:-1]).any(axis=1)) + 1
    starts = np.concatenate([np.arange(min(len(active), 1)), changes])
    _, numbers = np.unique(packed[starts].view(f"V{packed.shape[1]}")[:, 0], return_inverse=True)
    return starts, numbers


def subsample_states(logs: Sequence[Samples], count: int) -> Iterator[tuple[Samples, ContactState, float]]:
    """About `count` evenly spaced samples of every contact state, and the number of samples that each represents."""
    pieces_by_state: dict[ContactState, list[tuple[Samples, torch.Tensor]]] = {}
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in chunks_by_state(samples, max(len(samples), 1)):
            pieces_by_state.setdefault(state, []).append((samples, every[index]))
    for state, pieces in pieces_by_state.items():
        total = sum(len(index) for _, index in pieces)
        for samples, index in pieces:
            share = min(len(index), max(1, round(count * len(index) / total)))
            yield samples[index[torch.linspace(0, len(index) - 1, share).long()]], state, len(index) / share


def chunk_size(device: torch.device) -> int:
    """Default number of samples per chunk: on a GPU as many as its memory allows."""
    if device.type != "cuda":
        return CHUNK
    memory = torch.cuda.get_device_properties(device).total_memory
    return min(max(memory // (_SHARE_OF_GPU * _ON_GPU), CHUNK), _MOST_ON_GPU)


def worker_count(device: torch.device) -> int:
    """Default number of workers: on a CPU one per thread that torch would use, on a GPU one."""
    return thread_count() if device.type == "cpu" else 1


def upload(chunks: Iterable[tuple[Samples, Label]], device: torch.device) -> Iterator[tuple[Samples, Label]]:
    """Copy chunks, in order, to a device; on a CPU the chunks themselves.

    For a GPU, a separate thread makes them and copies them through page-locked memory on its own stream, at most one
    ahead. The work waits neither for the host nor for copies, and three chunks are in memory at most.

    Args:
        chunks: with further items each.
        device: of the work.
    """
    if device.type != "cuda":
        yield from ((samples.to(device), label) for samples, label in chunks)
        return
    stream = torch.cuda.Stream(device)

    def copy(chunk: tuple[Samples, Label]) -> tuple[Samples, Label, torch.cuda.Event]:
        samples, label = chunk
        locked = samples.pin_memory()
        with torch.cuda.stream(stream):
            return locked.to(device, non_blocking=True), label, stream.record_event()

    for samples, label, copied in one_ahead(map(copy, chunks)):
        working = torch.cuda.current_stream(device)
        working.wait_event(copied)
        samples.keep_for(working)  # otherwise a later copy could reuse its memory during the computation
        yield samples, label


def one_ahead(items: Iterable[Item]) -> Iterator[Item]:
    """The items; a separate thread makes the next one in advance."""
    following = iter(items)
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(thread_count(),)) as beside:
        made = beside.submit(list, islice(following, 1))
        while item := made.result():
            made = beside.submit(list, islice(following, 1))
            yield item[0]
