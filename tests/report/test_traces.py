"""Forces of a whole log in few points, and the spectrum of their errors."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from torchid.parameters import Array
from torchid.report.forces import ForceSeries, LogForces, traces_document

RATE, STD = 200.0, 0.3


def forces(samples: int, spike: int | None = None, gap: int | None = None, step: int = 1) -> LogForces:
    """Forces of two joints, measured with white noise; the identified parameters leave nothing but that."""
    rng = np.random.default_rng(0)
    time = 5.0 + np.arange(samples) * step / RATE
    if gap is not None:
        time[gap:] += 10.0
    true = np.sin(2.0 * np.pi * time)[:, None] * [1.0, 2.0]
    measured = true + STD * rng.standard_normal(true.shape)
    if spike is not None:
        measured[spike] += 100.0
    noise = np.full_like(true, STD)
    series = ForceSeries("log.npz", time, measured, 1.2 * true, true, noise)
    state = (np.arange(samples) >= samples // 2).astype(int)
    return LogForces(series, series, ("none", "foot"), state, step, 0.5 * RATE / step)


def unpacked(values: dict[str, str]) -> Array:
    return np.frombuffer(base64.b64decode(values["bdata"]), "<f4").astype(np.float64)


@pytest.mark.parametrize("samples", [1500, 50_001])
def test_a_peak_of_one_sample_is_seen_however_long_the_log_is(samples: int) -> None:
    document = traces_document(forces(samples, spike=1234), 0, ("hip", "knee"))
    assert document["recorded"]
    for panel in document["recorded"]:
        values = unpacked(panel["lines"]["measured"])
        assert len(values) == len(unpacked(document["time"])) <= 2000
        assert np.nanmax(values) > 90.0
        time = unpacked(document["time"])[np.nanargmax(values)]
        assert abs(time - 1234 / RATE) <= document["seconds"] / 1000.0


@pytest.mark.parametrize("samples", [1500, 50_001])
def test_no_line_and_no_contact_state_crosses_a_gap(samples: int) -> None:
    document = traces_document(forces(samples, gap=700), 0, ("hip", "knee"))
    time, values = unpacked(document["time"]), unpacked(document["recorded"][0]["lines"]["measured"])
    middle = 700 / RATE + 5.0
    assert np.isnan(values[np.flatnonzero(time < middle)[-1] + 1])
    assert all(end - start < 10.0 or start > middle or end < middle for start, end, _ in document["states"]["spans"])


def test_contact_states_cover_the_log() -> None:
    document = traces_document(forces(1000), 0, ("hip", "knee"))
    (first, changed, before), (again, end, after) = document["states"]["spans"]
    assert (first, before, after) == (0.0, 0, 1)
    assert changed == again == 500 / RATE
    assert end == pytest.approx(document["seconds"])


@pytest.mark.parametrize("step", [1, 4])
def test_white_noise_lies_at_the_noise_floor_at_all_frequencies(step: int) -> None:
    """Of std s up to B hertz the amplitude density is s / sqrt(B); 20 averaged segments leave it 16 % of scatter."""
    document = traces_document(forces(10_000, step=step), 0, ("hip", "knee"))
    assert document["projected"]
    for panel in document["projected"]:
        spectrum = panel["spectrum"]
        floor = STD / np.sqrt(0.5 * RATE / step)
        assert spectrum["noise"] == pytest.approx(floor, rel=1e-6)
        density = unpacked(spectrum["identified"])[1:-1]
        assert np.sqrt(np.mean(np.square(density))) == pytest.approx(floor, rel=0.03)
        assert unpacked(spectrum["nominal"]).max() > 2.0 * floor


def test_the_rows_with_the_largest_forces_are_named_with_units() -> None:
    document = traces_document(forces(1000), 0, ("hip", "sensor.fx"))
    assert [(panel["name"], panel["unit"]) for panel in document["recorded"]] == [("hip", "N m"), ("sensor.fx", "N")]
    assert document["recorded"][1]["rms"]["identified_error"] == pytest.approx(STD, rel=0.05)
    assert document["recorded"][1]["rms"]["noise"] == pytest.approx(STD)
