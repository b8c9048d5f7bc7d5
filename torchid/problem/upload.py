"""Chunks of samples on their way to a GPU: the next one is copied while the present one is worked on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import torch

from torchid.problem.samples import Samples

Label = TypeVar("Label")


def upload(chunks: Iterable[tuple[Samples, Label]], device: torch.device) -> Iterator[tuple[Samples, Label]]:
    """The chunks, in order, on a device; on a CPU the chunks themselves.

    For a GPU they go through page-locked memory on a stream of their own, at most one ahead of the chunk that is worked
    on: the host does not wait for copies, and the memory is that of three chunks, page-locked, copied and worked on.

    Args:
        chunks: with whatever goes with each.
        device: of the work.
    """
    if device.type == "cuda":
        return _one_ahead(chunks, _SideStream(device))
    return ((samples.to(device), label) for samples, label in chunks)


def _one_ahead(chunks: Iterable[tuple[Samples, Label]], copies: _SideStream) -> Iterator[tuple[Samples, Label]]:
    """The chunks as they arrive; the copy of the next one starts before one is handed over."""
    moving: tuple[Callable[[], Samples], Label] | None = None
    for samples, label in chunks:
        following = (copies.start(samples), label)
        if moving is not None:
            yield moving[0](), moving[1]
        moving = following
    if moving is not None:
        yield moving[0](), moving[1]


class _SideStream:
    """Copies to a GPU beside the work on it."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)

    def start(self, samples: Samples) -> Callable[[], Samples]:
        """Start to copy samples; call the result where they are needed.

        The present stream then waits for the copy, and the host for nothing.
        """
        locked = samples.pin_memory()
        with torch.cuda.stream(self._stream):
            there = locked.to(self._device, non_blocking=True)
            copied = self._stream.record_event()

        def arrived() -> Samples:
            working = torch.cuda.current_stream(self._device)
            working.wait_event(copied)
            there.keep_for(working)  # else its memory would be taken for a later copy while it is worked on
            return there

        return arrived
