"""Chunks on their way to a device: all of them, in order, one ahead. What a GPU does is stood in for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from random_samples import random_samples, sensor_set
from synthetic import SOLO12, load
from torch import Tensor

from torchid.problem import RowBuilder, Samples, compress
from torchid.problem.chunks import CHUNK, _one_ahead, _SideStream, chunk_size, map_chunks, upload
from torchid.problem.contact_state import ContactState
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


class Copies:
    """Copies that are done when somebody waits for them."""

    def __init__(self, events: list[str]) -> None:
        self.events = events

    def start(self, samples: Samples) -> object:
        number = int(samples.time[0] / 0.1 + 0.5)
        self.events.append(f"start {number}")

        def arrived() -> Samples:
            self.events.append(f"wait {number}")
            return samples

        return arrived


def test_the_next_chunk_and_no_other_is_made_and_copied_while_one_is_worked_on(samples: Samples) -> None:
    events: list[str] = []
    for chunk, number in _one_ahead(chunks_of(samples, events), Copies(events)):
        assert torch.equal(chunk.time, samples.time[10 * number : 10 * number + 10])
        until = time.monotonic() + 60.0
        while number < 5 and f"start {number + 1}" not in events:
            assert time.monotonic() < until, "the next chunk waits for the work on this one"
            time.sleep(0.001)
        assert f"cut {number + 2}" not in events
        events.append(f"work {number}")
    assert [event for event in events if "work" in event] == [f"work {number}" for number in range(6)]
    for number in range(6):
        assert events.index(f"cut {number}") < events.index(f"start {number}") < events.index(f"wait {number}")


def test_a_chunk_that_cannot_be_made_ends_the_work(samples: Samples) -> None:
    def failing() -> Iterator[tuple[Samples, int]]:
        yield samples, 0
        raise OSError("gone")

    chunks = _one_ahead(failing(), Copies([]))
    next(chunks)
    with pytest.raises(OSError, match="gone"):
        next(chunks)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_chunks_arrive_too(samples: Samples, count: int) -> None:
    chunks = [(samples[number : number + 1], number) for number in range(count)]
    assert [number for _, number in _one_ahead(iter(chunks), Copies([]))] == list(range(count))


def test_copies_go_through_locked_memory_on_a_stream_that_the_work_waits_for(
    samples: Samples, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []

    class Stream:
        def __init__(self, device: torch.device | None = None) -> None:
            assert device == META

        def record_event(self) -> str:
            events.append("copied")
            return "event"

        def wait_event(self, event: str) -> None:
            events.append(f"wait for {event}")

    working = Stream(META)

    @contextmanager
    def stream(chosen: Stream) -> Iterator[None]:
        assert chosen is not working
        events.append("beside")
        yield
        events.append("back")

    def pin_memory(x: Tensor) -> Tensor:
        events.append("lock")
        return x

    move = Tensor.to

    def to(x: Tensor, device: torch.device, non_blocking: bool = False) -> Tensor:
        events.append("copy, go on" if non_blocking else "copy and wait")
        return move(x, device)

    for place, name, value in (
        (torch.cuda, "Stream", Stream),
        (torch.cuda, "stream", stream),
        (torch.cuda, "current_stream", lambda device: working),
        (Tensor, "pin_memory", pin_memory),
        (Tensor, "record_stream", lambda x, chosen: events.append("keep" if chosen is working else "?")),
        (Tensor, "to", to),
    ):
        monkeypatch.setattr(place, name, value)
    arrived = _SideStream(META).start(samples)
    tensors = 11  # time, joints, base, torque, wrench, active
    assert events == [*["lock"] * tensors, "beside", *["copy, go on"] * tensors, "copied", "back"]
    events.clear()
    there = arrived()
    assert events == ["wait for event", *["keep"] * tensors]
    assert there.torque.device == META
    assert there.torque.shape == samples.torque.shape


def test_a_log_is_the_same_whether_its_chunks_are_one_ahead_or_not(
    samples: Samples, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, contacts = load(SOLO12), [Contact("FL_FOOT", "point")]
    builder = RowBuilder(robot, contacts, sensor_set("full", robot, contacts))
    one = compress([samples], builder, 7, threads=1).triangle()
    monkeypatch.setattr("torchid.problem.chunks.upload", lambda chunks, device: _one_ahead(chunks, Copies([])))
    assert torch.equal(compress([samples], builder, 7, threads=1).triangle(), one)


def test_a_gpu_gets_larger_chunks_unless_a_call_says_how_large(
    samples: Samples, monkeypatch: pytest.MonkeyPatch
) -> None:
    for memory, expected in ((2**30, CHUNK), (2**33, 21845), (2**37, 64 * CHUNK)):
        properties = SimpleNamespace(total_memory=memory)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device, found=properties: found)
        assert chunk_size(CUDA) == expected
    assert chunk_size(CPU) == CHUNK
    robot, contacts = load(SOLO12), [Contact("FL_FOOT", "point")]
    builder = RowBuilder(robot, contacts, sensor_set("full", robot, contacts))

    def sizes(pieces: Iterator[tuple[Samples, ContactState]]) -> list[int]:
        return [len(piece) for piece, _ in pieces]

    monkeypatch.setattr("torchid.problem.chunks.chunk_size", lambda device: 25)
    ((*found,),) = map_chunks([samples], builder, sizes, threads=1)
    assert max(found) <= 25
    assert sum(found) == len(samples)
    ((*found,),) = map_chunks([samples], builder, sizes, 4, threads=1)
    assert max(found) == 4
