"""Forces of a whole log in few points, and the spectrum of their errors."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from torchid.report.forces import ForceSeries, _spans, _spectrum, _Thinned, force_figure, spectrum_figure

RATE, STD = 200.0, 0.3


def forces(samples: int, spike: int | None = None, gap: int | None = None, step: int = 1) -> ForceSeries:
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
    state = (np.arange(samples) >= samples // 2).astype(int)
    series = ForceSeries("log.npz", time, measured, 1.2 * true, true, noise, states=("none", "foot"), state=state)
    return replace(series, bandwidth=0.5 * RATE / step)


def stays(log: ForceSeries) -> list[tuple[float, float, int]]:
    assert log.state is not None
    return _spans(log.time, log.state)


@pytest.mark.parametrize("samples", [1500, 50_001])
def test_a_peak_of_one_sample_is_seen_however_long_the_log_is(samples: int) -> None:
    series = forces(samples, spike=1234)
    thin = _Thinned(series.time)
    values = thin(series.measured[:, 0])
    assert len(values) == len(thin.time) <= 2000
    assert np.nanmax(values) > 90.0
    assert abs(thin.time[np.nanargmax(values)] - series.time[1234]) <= np.ptp(series.time) / 1000.0


@pytest.mark.parametrize("samples", [1500, 50_001])
def test_no_line_and_no_contact_state_crosses_a_gap(samples: int) -> None:
    log = forces(samples, gap=700)
    thin = _Thinned(log.time)
    assert thin.has_gaps
    values, middle = thin(log.measured[:, 0]), log.time[700] - 5.0
    assert np.isnan(values[np.flatnonzero(thin.time < middle)[-1] + 1])
    assert all(end - start < 10.0 or start > middle or end < middle for start, end, _ in stays(log))


def test_contact_states_cover_the_log() -> None:
    log = forces(1000)
    (first, changed, before), (again, end, after) = stays(log)
    assert (first, before, after) == (log.time[0], 0, 1)
    assert changed == again == log.time[500]
    assert end == pytest.approx(log.time[-1])


@pytest.mark.parametrize("step", [1, 4])
def test_white_noise_lies_at_the_noise_floor_at_all_frequencies(step: int) -> None:
    """Of std s up to B hertz the amplitude density is s / sqrt(B); 20 averaged segments leave it 16 % of scatter."""
    log = forces(10_000, step=step)
    for row in range(2):
        spectrum = _spectrum(log, row, log.time)
        assert spectrum is not None
        floor = STD / np.sqrt(0.5 * RATE / step)
        assert spectrum.noise == pytest.approx(floor, rel=1e-6)
        assert np.sqrt(np.mean(np.square(spectrum.identified[1:-1]))) == pytest.approx(floor, rel=0.03)
        assert spectrum.nominal.max() > 2.0 * floor


def test_forces_and_spectra_are_named_with_units_and_states_with_colours() -> None:
    rows = force_figure(forces(1000), ("hip", "sensor.fx"), 0)
    titles = [axis.get_title(loc="left") for axis in rows.axes]
    assert titles[0::2] == ["hip", "sensor.fx"]
    assert [axis.get_ylabel() for axis in rows.axes[0::2]] == ["[N m]", "[N]"]
    rms, noise = map(float, re.findall(r"identified ([\d.]+), noise ([\d.]+)", titles[1])[0])
    assert (rms, noise) == pytest.approx((STD, STD), rel=0.05)
    assert "foot" in [text.get_text() for text in rows.legends[0].get_texts()]
    spectra = spectrum_figure(forces(1000), ("hip", "sensor.fx"), 0)
    assert [axis.get_title(loc="left") for axis in spectra.axes] == ["hip [N m/√Hz]", "sensor.fx [N/√Hz]"]
    assert "no segment" in spectrum_figure(forces(20), ("hip", "knee"), 0).get_suptitle()
