"""What the choice of sensors costs: accuracy expected from the training logs, and measured on logs no fit has seen."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rich.progress import Progress

from torchid.analysis.accuracy import error_directions
from torchid.errors import LogError, TorchidWarning
from torchid.problem import RowBuilder, Samples
from torchid.problem.measured import measured_components
from torchid.problem.samples import check_forces
from torchid.problem.streaming import compress_parts
from torchid.report.accuracy import SetAccuracy
from torchid.report.expected import expected_errors
from torchid.report.metrics import Evaluation
from torchid.run.estimation import assembled, batch_estimator, stated_conditions
from torchid.run.experiment import Scene
from torchid.sensing import SensorSet


def accuracies(
    scene: Scene,
    sets: Mapping[str, SensorSet],
    train: Sequence[Samples],
    test: Sequence[Samples],
    bars: Progress,
    source: object = "experiment",
) -> dict[str, SetAccuracy]:
    """Fit with every sensor set that the training logs recorded; a descent is stood in for by least squares.

    Warns:
        TorchidWarning: the training logs lack a sensor of a set, which is left out.
    """
    bar = bars.add_task("comparing sensor sets", total=len(sets))
    evaluation = Evaluation(scene.robot, scene.contacts, scene.config.device)
    out = {}
    for name, sensors in sets.items():
        try:
            for samples in train:
                check_forces(samples, scene.robot, scene.contacts, sensors)
        except LogError as error:
            message = f"{error.source}: {error.field}: {error.found}; no accuracy of the sensors '{name}'"
            warnings.warn(message, TorchidWarning, stacklevel=2)
        else:
            out[name] = _accuracy(scene, sensors, train, test, evaluation, source)
        bars.advance(bar)
    return out


def _accuracy(
    scene: Scene,
    sensors: SensorSet,
    train: Sequence[Samples],
    test: Sequence[Samples],
    evaluation: Evaluation,
    source: object,
) -> SetAccuracy:
    settings, robot = scene.config.estimator, scene.robot
    builder = RowBuilder(robot, scene.contacts, sensors, scene.terms).to(scene.config.device)
    problem = assembled(compress_parts(train, builder), builder, robot, settings, source).problem
    if settings.name == "sgd":
        settings = replace(settings, name="least_squares")
    estimator = batch_estimator(settings, stated_conditions(settings, robot, source))
    estimate = estimator.solve(problem)
    noise = estimate.residual_std
    variance = noise**2 * problem.oversampling
    prior_error = scene.config.analysis.prior_error
    directions = error_directions(problem, settings.ridge, variance, prior_error, settings.rank_tolerance)
    found = scene.noise.times(noise)
    expected = expected_errors(evaluation.builder, test or train, directions, found)
    measured = evaluation.metrics(test, estimate.phi[None])[0] if test else None
    possible = measured_components(scene.contacts, sensors)
    return SetAccuracy(int(sensors.torque.sum() + possible.sum()), estimate.rank, expected, measured)
