"""Forces of the first samples of a log: measured, and predicted by the nominal and by the identified parameters."""

from __future__ import annotations

import numpy as np

from torchid.config import ExperimentConfig
from torchid.fitting.calibration import Calibration, Comparison
from torchid.logs.time_range import log_title
from torchid.problem import Evaluation, Samples
from torchid.problem.predict import force_series, noise_series
from torchid.report.forces import ForceSeries
from torchid.sensing import SensorNoise

_SAMPLES = 3000


def noise_of_readings(config: ExperimentConfig, stated: bool) -> SensorNoise | None:
    """The noise of readings as recorded, NaN where it is unknown; None where it is not `stated` of any sensor.

    Noise that was estimated beside a stated one is in proportion to it. Without any, it comes from the residuals
    themselves, which it could not judge.
    """
    return SensorNoise.of_known(config.sensors.noise.forces) if stated else None


def compare_forces(evaluation: Evaluation, samples: Samples, compared: Comparison[Calibration]) -> ForceSeries:
    """Forces of a log's first samples: nominal, identified, and measured as the latter calibrates it.

    Each prediction is as far from what was measured as from readings that are calibrated for it.
    """
    measured, predicted = [], []
    for one in compared:
        (read,) = one.calibrate([samples])
        part = read[:_SAMPLES]
        readings, (forces,) = force_series(evaluation.builder, part, one.parameters(evaluation)[None])
        measured.append(readings)
        predicted.append(forces)
    nominal = predicted[0] + np.nan_to_num(measured[1] - measured[0])  # NaN: not measured
    noise = None if evaluation.noise is None else noise_series(evaluation.builder, part, evaluation.noise)
    return ForceSeries(log_title(samples.source), part.time.numpy(), measured[1], nominal, predicted[1], noise)
