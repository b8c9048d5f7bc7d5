"""Forces of a log: measured, and predicted by the nominal and by the identified parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from torchid.config import ExperimentConfig
from torchid.fitting.calibration import Calibration, Comparison
from torchid.logs.time_range import log_title
from torchid.problem import Evaluation, Samples
from torchid.problem.contact_state import state_name
from torchid.problem.predict import at_motors, force_series, noise_series, projected_forces
from torchid.report.forces import ForceSeries
from torchid.report.traces import LogForces
from torchid.sensing import SensorNoise

_SAMPLES = 3000
_TRACED = 10_000  # of a whole log: the rows of the fit take 0.1 ms each
_SERIES = ("measured", "nominal", "identified", "noise")


def noise_of_readings(config: ExperimentConfig, stated: bool) -> SensorNoise | None:
    """The noise of readings as recorded, NaN where it is unknown; None where it is not `stated` of any sensor.

    Noise that was estimated beside a stated one is in proportion to it. Without any, it comes from the residuals
    themselves, which it could not judge.
    """
    return SensorNoise.of_known(config.sensors.noise.forces) if stated else None


def compare_forces(
    evaluation: Evaluation, samples: Samples, compared: Comparison[Calibration], chosen: slice = slice(_SAMPLES)
) -> ForceSeries:
    """Forces of chosen samples of a log: nominal, identified, and measured as the latter calibrates it.

    Each prediction is as far from what was measured as from readings that are calibrated for it.
    """
    measured, predicted = [], []
    for one in compared:
        (read,) = one.calibrate([samples])
        part = read[chosen]
        series = force_series(evaluation.builder, part, one.parameters(evaluation)[None])
        readings, forces = at_motors(evaluation.builder, part, np.stack([series[0], *series[1]]))
        measured.append(readings)
        predicted.append(forces)
    nominal = predicted[0] + np.nan_to_num(measured[1] - measured[0])  # NaN: not measured
    noise = None if evaluation.noise is None else noise_series(evaluation.builder, part, evaluation.noise)
    return ForceSeries(log_title(samples.source), part.time.numpy(), measured[1], nominal, predicted[1], noise)


def trace_forces(evaluation: Evaluation, samples: Samples, compared: Comparison[Calibration]) -> LogForces:
    """Forces of a whole log as recorded, and in the rows of the fit; of a long log every k-th sample."""
    step = max(1, -(-len(samples) // _TRACED))
    recorded = compare_forces(evaluation, samples, compared, slice(None, None, step))
    part, builder = samples.every(step), compared.identified.builder
    projected = projected_forces(builder, part, torch.stack([one.columns(builder, samples) for one in compared]))
    present = list(dict.fromkeys(map(tuple, part.active.tolist())))
    names = {state: state_name(builder.contacts, state) for state in present}
    rate = 1.0 / float(samples.time.diff().median()) if len(samples) > 1 else np.nan
    return LogForces(
        recorded=recorded,
        projected=replace(
            recorded, **dict(zip(_SERIES, (projected.measured, *projected.predicted, projected.noise), strict=True))
        ),
        states=tuple(names.values()),
        state=np.array([present.index(tuple(active)) for active in part.active.tolist()]),
        step=step,
        bandwidth=0.5 * rate / max(samples.oversampling, step),
    )
