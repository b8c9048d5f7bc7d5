"""Chunks on their way to a device: all of them, in order, one ahead. What a GPU does is stood in for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import torch
from random_samples import random_samples
from synthetic import SOLO12, load

from torchid.problem import Samples
from torchid.problem.chunks import CHUNK, chunk_size, one_ahead, upload
from torchid.sensing import Contact

CPU, CUDA, META = torch.device("cpu"), torch.device("cuda"), torch.device("meta")


@pytest.fixture(scope="module")
def samples() -> Samples:
    return random_samples(load(SOLO12), [Contact("FL_FOOT", "point")], 60, 0)[0]


def chunks_of(samples: Samples, events: list[str] | None = None) -> Iterator[tuple[Samples, int]]:
    for number in range(6):
        if events is not None:
            events.append(f"cut {number}")
        yield samples[10 * number : 10 * number + 10], number


def test_on_a_cpu_chunks_are_handed_over_as_they_are(samples: Samples) -> None:
    events: list[str] = []
    for chunk, number in upload(chunks_of(samples, events), CPU):
        assert events[-1] == f"cut {number}", "cut ahead of the work"
        assert chunk.torque.data_ptr() == samples.torque[10 * number].data_ptr(), "copied"
        assert torch.equal(chunk.time, samples.time[10 * number : 10 * number + 10])
    assert number == 5


def test_the_next_chunk_and_no_other_is_made_while_one_is_worked_on(samples: Samples) -> None:
    events: list[str] = []
    for chunk, number in one_ahead(chunks_of(samples, events)):
        assert torch.equal(chunk.time, samples.time[10 * number : 10 * number + 10])
        until = time.monotonic() + 60.0
        while number < 5 and f"cut {number + 1}" not in events:
            assert time.monotonic() < until, "the next chunk waits for the work on this one"
            time.sleep(0.001)
        assert f"cut {number + 2}" not in events
        events.append(f"work {number}")
    assert [event for event in events if "work" in event] == [f"work {number}" for number in range(6)]


def test_a_gpu_gets_larger_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    for memory, expected in ((2**30, CHUNK), (2**33, 21845), (2**37, 64 * CHUNK)):
        properties = SimpleNamespace(total_memory=memory)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device, found=properties: found)
        assert chunk_size(CUDA) == expected
    assert chunk_size(CPU) == CHUNK
