"""Trainings as part of a run, stopped and compared."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from run_folders import names_in
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchid.estimators import Trainer

EPOCHS, EVERY = 16, 5


EVALUATED = sorted({*range(0, EPOCHS + 1, EVERY), EPOCHS})


BY_EPOCH = list(range(1, EPOCHS + 1))


def command(experiment: Path, output: Path, *more: str) -> list[str]:
    return ["identify", str(experiment / "experiment.yaml"), f"output={output}", *more]


def training_of(output: Path) -> Path:
    return output.with_name(f"{output.name}.training")


def stopped_in(epoch: int, monkeypatch: pytest.MonkeyPatch, by: Callable[[], object]) -> pytest.MonkeyPatch:
    """Let something happen when an epoch begins."""
    plain_epoch = Trainer.run_epoch

    def run_epoch(trainer: Trainer) -> Any:
        if trainer.epoch + 1 == epoch:
            by()
        return plain_epoch(trainer)

    monkeypatch.setattr(Trainer, "run_epoch", run_epoch)
    return monkeypatch


def interrupt(number: int = signal.SIGINT) -> Callable[[], None]:
    return lambda: signal.raise_signal(number)


def events_in(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0, "tensors": 0})
    events.Reload()
    return events


def steps(events: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in events.Scalars(tag)]


def assert_as_uninterrupted(output: Path, run: Path) -> None:
    """The same results to the last byte, the same curves, no step twice or missing, and all beside them gone."""
    for name in ("parameters.json", "identified.urdf"):
        assert (output / name).read_bytes() == (run / name).read_bytes()
    found, expected = (json.loads((folder / "metrics.json").read_text()) for folder in (output, run))
    assert found | {"seconds": None} == expected | {"seconds": None}
    assert names_in(output.parent) == [output.name]
    curves, whole = events_in(output), events_in(run)
    assert curves.Tags()["scalars"] == whole.Tags()["scalars"]
    for tag in whole.Tags()["scalars"]:
        values = {event.step: event.value for event in whole.Scalars(tag)}
        assert steps(curves, tag) == steps(whole, tag)
        if tag != "training/samples_per_second":
            assert all(event.value == values[event.step] for event in curves.Scalars(tag))
