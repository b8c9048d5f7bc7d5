"""Accuracy of sensor sets: what a fit of the training logs with each leaves on the test logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

from torchid import distributed
from torchid.commands.plausibility import TrainingLogs, require_plausible
from torchid.errors import ImplausibleFitError, LogError, warn
from torchid.estimators.least_squares import Minimizer
from torchid.fitting.experiment import RobotSetup, batch_estimator
from torchid.fitting.fit import calibration_at, list_confounded
from torchid.parallel import share_between_forks, thread_count
from torchid.problem import Evaluation, RowBuilder, Samples, assemble, compress_parts
from torchid.problem.compression import split_into_folds
from torchid.problem.elimination import Assembly
from torchid.problem.samples import require_forces
from torchid.report.analysis import SetAccuracy
from torchid.sensing import SensorSet, named_sensors, with_ft_sensors
from torchid.sensing.sensors import measured_components


def accuracies(
    setup: RobotSetup,
    sets: Mapping[str, SensorSet],
    train: Sequence[Samples],
    test: Sequence[Samples],
) -> dict[str, SetAccuracy]:
    """Fit with every sensor set that the training logs recorded, by least squares instead of a descent.

    Predictions are compared with readings calibrated for the parameters of each fit, by all sensors if the training
    logs have them, or else by the set's.

    Warns:
        TorchidWarning: the training logs lack a sensor of a set, or no robot can have left its fit; it is left out.
    """
    evaluation = setup.evaluation()
    reference = _reference(setup, train)

    def accuracy(name: str) -> SetAccuracy | None:
        try:
            for samples in train:
                require_forces(samples, setup.robot, setup.contacts, sets[name])
            return _accuracy(setup, sets[name], train, test, evaluation, reference)
        except LogError as error:
            warn(f"{error.source}: {error.field}: {error.found}; no accuracy of the sensors '{name}'")
        except ImplausibleFitError as error:
            warn(f"{error}; no accuracy of the sensors '{name}'")
        return None

    results = zip(sets, share_between_forks(list(sets), accuracy, thread_count()), strict=True)
    return {name: result for name, result in results if result is not None}


def _reference(setup: RobotSetup, train: Sequence[Samples]) -> tuple[Assembly, RowBuilder] | None:
    """The training logs' rows of all sensors, which extra parameters are taken from; None if a log lacks a sensor."""
    robot = setup.robot
    sensors = named_sensors("full", robot.n, len(setup.contacts), setup.noise, len(robot.ft_names))
    sensors = with_ft_sensors(sensors, robot, robot.ft_names)
    builder = setup.builder(sensors)
    if not builder.extras:
        return None
    try:
        for samples in train:
            require_forces(samples, robot, setup.contacts, sensors)
    except LogError:
        return None
    return assemble(compress_parts(train, builder), builder, robot), builder


def _accuracy(
    setup: RobotSetup,
    sensors: SensorSet,
    train: Sequence[Samples],
    test: Sequence[Samples],
    evaluation: Evaluation,
    reference: tuple[Assembly, RowBuilder] | None,
) -> SetAccuracy:
    settings = setup.config.estimator
    builder = setup.builder(sensors)
    conditions = setup.conditions()
    fitter = setup.fitter(builder, conditions)
    if settings.name == "sgd":
        settings = replace(settings, name="least_squares")
    blocks = split_into_folds(train, builder) if settings.chooses_ridge else list(train)
    parts = compress_parts(blocks, builder)
    if settings.chooses_ridge:
        choice = distributed.from_first(partial(setup.choose_ridge, parts, blocks, fitter, conditions), "ridge")
        settings = replace(settings, ridge=choice.ridge)
    fit = fitter.fit(parts, batch_estimator(settings, conditions).solve)
    require_plausible(fit, TrainingLogs(setup))
    estimate = fit.estimate
    assembly, builder = reference or (fit.assembly, builder)
    calibration = calibration_at(assembly, Minimizer(estimate.phi), setup.robot, builder)
    phi = calibration.parameters(evaluation)
    measured = evaluation.metrics(calibration.calibrate(test), phi[None])[0] if test else None
    possible = measured_components(setup.contacts, sensors)
    channels = int(sensors.torque.sum() + possible.sum())
    confounded = list_confounded(fit.extras)
    words = tuple(map(str, confounded))
    advice = tuple(confusion.in_short for confusion in confounded)
    return SetAccuracy(channels, estimate.rank, measured, words, advice)
