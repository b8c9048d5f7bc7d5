"""What a finished identification holds, and the folder it is written to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchid.commands.folder import new_folder, write_json
from torchid.commands.training import Training, body_eigenvalues
from torchid.config import ExperimentConfig, dump_config
from torchid.errors import during
from torchid.estimators import ConstrainedEstimate, Estimate, SgdEstimate, Violation
from torchid.fitting.calibration import Calibration, Comparison, list_confounded
from torchid.fitting.cross_validation import CrossValidation, RidgeChoice
from torchid.fitting.experiment import Experiment
from torchid.fitting.factor_files import FactorFile
from torchid.fitting.misfit import Misfit
from torchid.fitting.noise import NoiseSummary
from torchid.fitting.robust import RobustSummary
from torchid.fitting.sign_width import SignWidthChoice
from torchid.identifiability.base_parameters import StateReport
from torchid.identifiability.confounding import ExtraEstimate, TotalMass
from torchid.identifiability.contributions import Contributions
from torchid.logs.cutoff import CutoffChoice
from torchid.logs.time_range import log_title
from torchid.parameters import PER_BODY, Array
from torchid.problem import Evaluation, Metrics, Samples
from torchid.problem.metrics import SETS, WHITENED, WorseThanNominal, describe_worse, worse_than_nominal
from torchid.problem.predict import force_series, noise_series
from torchid.problem.surplus import NoiseShares
from torchid.report import identified_urdf, parameters_document
from torchid.report.figures import (
    contribution_figure,
    error_figure,
    extra_figure,
    identifiability_figure,
    parameter_figure,
    save_figure,
)
from torchid.report.forces import ForceSeries, force_figure
from torchid.report.ridge import ridge_figure
from torchid.report.tables import table_text, verdict_counts_table
from torchid.report.tensorboard import RunEvents
from torchid.sensing import SensorNoise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLOTTED_SAMPLES = 3000
HELD_OUT = "blocks left out of the fit"
"""Name of the training samples that cross-validation predicts, in messages."""


@dataclass(frozen=True, kw_only=True)
class Identification:
    """A finished run.

    Attributes:
        experiment: robot, contacts, sensors and settings, with the noise and the ridge that were used.
        estimate: the fit.
        extras: offsets, scales and actuator terms.
        noise: that rows were weighed with.
        motion_noise: what noise of the motion had added to the normal equations.
        misfit: what the fit leaves of the forces, and what noise would leave.
        robust: how outliers were weighed down, if so.
        states: contact states of the training logs.
        by_state: what each of them determines on its own.
        contributions: what each training log, contact state and sensor adds.
        metrics: errors by set of logs, "train" and "test".
        evaluated: number of samples whose forces were predicted, by set of logs.
        violations: conditions that the identified parameters break.
        seconds: by step of the run.
        samples: number of training samples.
        factors: the training logs, where they came compressed.
        excluded: condemned samples left out, by log.
        mass: the total mass and how well it is known.
        validation: errors on held-out blocks, None where the samples are too few to leave some out.
        ridge: how it was chosen, if it was.
        cutoff: likewise.
        sign_width: likewise.
        reused: what an earlier run has left in the cache, in words.
    """

    experiment: Experiment
    estimate: Estimate
    extras: list[ExtraEstimate]
    noise: NoiseSummary
    motion_noise: NoiseShares
    misfit: Misfit
    robust: RobustSummary | None
    states: list[StateReport]
    by_state: dict[str, Estimate]
    contributions: Contributions
    metrics: dict[str, Comparison[Metrics]]
    evaluated: Mapping[str, int]
    violations: list[Violation]
    seconds: dict[str, float]
    samples: int
    factors: Sequence[FactorFile]
    excluded: Mapping[str, int]
    mass: TotalMass
    validation: CrossValidation | None
    ridge: RidgeChoice | None
    cutoff: CutoffChoice | None
    sign_width: SignWidthChoice | None
    reused: Sequence[str] = ()

    def violations_by_name(self) -> list[dict[str, object]]:
        """Conditions that the identified parameters break, the body by its name."""
        names = self.experiment.robot.body_names
        return [asdict(x) | {"body": None if x.body is None else names[x.body]} for x in self.violations]

    @cached_property
    def worse(self) -> list[WorseThanNominal]:
        """Groups of rows where the URDF predicts better, on blocks left out of the fit or on the test logs."""
        sets = {} if self.validation is None else {HELD_OUT: (self.validation.nominal, self.validation.identified)}
        return worse_than_nominal(sets | ({"test logs": self.metrics["test"]} if "test" in self.metrics else {}))

    def state_entries(self) -> list[dict[str, object]]:
        """Contact states, with what each of them adds."""
        contributions = {state.name: asdict(state) for state in self.contributions.states}
        return [asdict(state) | contributions[state.name] for state in self.states]

    @property
    def phi(self) -> Array:
        """Identified parameters, (L, 12)."""
        return self.estimate.phi.reshape(-1, PER_BODY)


def write_run(
    run: Identification,
    evaluation: Evaluation,
    plotted: Samples | None,
    compared: Comparison[Calibration],
    training: Training | None,
) -> None:
    """Write the run folder.

    Args:
        run: what to write.
        evaluation: for the predicted forces.
        plotted: log of the figure of forces, as recorded; None: no such figure.
        compared: parameters, with the extra parameters that suit them.
        training: whose curves go into the folder, and whose checkpoint is then no longer needed.
    """
    config, robot = run.experiment.config, run.experiment.robot
    figures = {
        **({} if plotted is None else {"forces": draw_forces(evaluation, plotted, compared)}),
        "errors": error_figure(run.metrics),
        "parameters": parameter_figure(
            robot.body_names, robot.nominal, run.phi, run.estimate.standard_error.reshape(-1, PER_BODY)
        ),
        "identifiability": identifiability_figure(robot.body_names, run.estimate),
        "contributions": contribution_figure(_bits(run.contributions)),
    }
    if run.extras:
        figures["extras"] = extra_figure(run.extras)
    if run.ridge is not None:
        figures["ridge"] = ridge_figure(run.ridge)
    with during("writing", config.output), new_folder(config.output, config.overwrite) as folder:
        (folder / "config.yaml").write_text(dump_config(config))
        write_json(folder / "parameters.json", parameters_document(robot, run.estimate, run.by_state, run.extras))
        write_json(folder / "metrics.json", metrics_document(run))
        (folder / "identified.urdf").write_bytes(identified_urdf(robot, run.phi))
        for name, figure in figures.items():
            save_figure(figure, folder / f"{name}.png")
        if training is not None:
            training.copy_curves(folder)
        _write_curves(run, folder, {name: folder / f"{name}.png" for name in figures})
    if training is not None:
        training.remove_checkpoint()


def noise_of_readings(config: ExperimentConfig, stated: bool) -> SensorNoise | None:
    """The noise of readings as recorded, NaN where it is unknown; None where it is not `stated` of any sensor.

    Noise that was estimated beside a stated one is in proportion to it. Without any, it comes from the residuals
    themselves, which it could not judge.
    """
    return SensorNoise.of_known(config.sensors.noise.forces) if stated else None


def draw_forces(evaluation: Evaluation, samples: Samples, compared: Comparison[Calibration]) -> Figure:
    """The figure of forces of a log's first samples: nominal, identified, and measured as the latter calibrates it.

    Each prediction is as far from what was measured as from readings that are calibrated for it.
    """
    measured, predicted = [], []
    for one in compared:
        (read,) = one.calibrate([samples])
        part = read[:_PLOTTED_SAMPLES]
        readings, (forces,) = force_series(evaluation.builder, part, one.parameters(evaluation)[None])
        measured.append(readings)
        predicted.append(forces)
    robot, nominal = evaluation.robot, predicted[0] + np.nan_to_num(measured[1] - measured[0])  # NaN: not measured
    noise = None if evaluation.noise is None else noise_series(evaluation.builder, part, evaluation.noise)
    series = ForceSeries(log_title(samples.source), part.time.numpy(), measured[1], nominal, predicted[1], noise)
    return force_figure(series, robot.dof_names, robot.base_rows)


def metrics_document(run: Identification) -> dict[str, object]:
    """What `metrics.json` holds: errors of the identified and of the nominal parameters."""
    estimate, robot = run.estimate, run.experiment.robot
    document: dict[str, object] = {}
    for name in SETS:
        pair = run.metrics.get(name)
        document[name] = None if pair is None else pair.identified.as_dict()
        document[f"{name}_nominal"] = None if pair is None else pair.nominal.as_dict()
    variation = {name: pair.identified.base_force_of_variation for name, pair in run.metrics.items()}
    return document | {
        "noise_floor": {name: pair.identified.noise for name, pair in run.metrics.items()},
        "base_force_rms_of_variation": variation,
        "rank": estimate.rank,
        "parameters": int(estimate.phi.size),
        "condition_number": estimate.condition_number if estimate.rank else None,
        "samples": run.samples,
        "evaluated_samples": dict(run.evaluated),
        "excluded_samples": run.excluded,
        **({"factors": [_factor_entry(one) for one in run.factors]} if run.factors else {}),
        "rows": estimate.rows,
        "residual_std": estimate.residual_std,
        "misfit": _misfit_document(run.misfit),
        "motion_noise": asdict(run.motion_noise),
        "total_mass": run.mass.value if run.mass.determined else None,
        "total_mass_standard_error": run.mass.standard_error if np.isfinite(run.mass.standard_error) else None,
        "total_mass_told_from_offsets": run.mass.separable,
        "confounded": [asdict(one) | {"message": str(one)} for one in list_confounded(run.extras)],
        "total_mass_nominal": float(robot.nominal[:, 0].sum()),
        "smallest_eigenvalue": body_eigenvalues(robot, estimate.phi),
        "noise": {"groups": [asdict(one) for one in run.noise.groups], "suggested": run.noise.suggested},
        "robust": None if run.robust is None else asdict(run.robust),
        "violations": run.violations_by_name(),
        "solution": _solution_document(estimate),
        "cross_validation": _validation_document(run),
        "ridge_selection": None if run.ridge is None else asdict(run.ridge),
        "cutoff_selection": None if run.cutoff is None else asdict(run.cutoff),
        "sign_width_selection": None if run.sign_width is None else asdict(run.sign_width),
        "worse_than_nominal": [asdict(one) for one in run.worse],
        "verdict": describe_worse(run.worse),
        "contact_states": run.state_entries(),
        "identifiability": _identifiability_document(run),
        "seconds": run.seconds,
    }


def _misfit_document(misfit: Misfit) -> dict[str, object]:
    """What the fit leaves of the forces."""
    return {
        "explained": misfit.explained,
        "message": str(misfit),
        "expected_residual_std": misfit.expected,
        "lack_of_fit": misfit.lack_of_fit,
        "standard_error_growth": misfit.error_growth,
    }


def _factor_entry(factors: FactorFile) -> dict[str, object]:
    """Which log a file of factors is of."""
    log = factors.log
    names = {"file": log.source, "log": factors.name, "sha256": factors.sha256, "torchid": factors.version}
    return names | {"samples": log.samples, "duration_s": factors.duration}


def _validation_document(run: Identification) -> dict[str, object] | None:
    """Errors on blocks of the training logs of what was fitted without them."""
    validation = run.validation
    if validation is None:
        return None
    nominal, identified = validation.nominal.as_dict(), validation.identified.as_dict()
    return {"folds": validation.folds, "nominal": nominal, "identified": identified}


def _identifiability_document(run: Identification) -> dict[str, object]:
    """What the data determine, and what each log and sensor adds; contact states have a list of their own."""
    estimate, contributions = run.estimate, run.contributions
    return {
        "singular_values": estimate.singular_values.tolist(),
        "condition_number": estimate.condition_number if estimate.rank else None,
        "oversampling": estimate.oversampling,
        **asdict(contributions.total),
        "verdicts": estimate.verdict_counts(),
        "logs": [asdict(log) for log in contributions.logs],
        "sensors": [asdict(sensor) for sensor in contributions.sensors],
    }


def _bits(contributions: Contributions) -> dict[str, list[tuple[str, float]]]:
    """Names and bits, by kind."""
    return {
        "logs": [(log_title(log.name), log.bits) for log in contributions.logs],
        "contact states": [(state.name, state.bits) for state in contributions.states],
        "sensors": [(sensor.name, sensor.bits) for sensor in contributions.sensors],
    }


def _solution_document(estimate: Estimate) -> dict[str, object] | None:
    """What is known of the optimum, or of the descent."""
    if not isinstance(estimate, ConstrainedEstimate):
        return None
    names = ("objective", "unconstrained", "distance", "gap", "certified_gap", "steps", "epochs", "best_epoch")
    return {name: getattr(estimate, name) for name in names if hasattr(estimate, name)}


def _write_curves(run: Identification, folder: Path, figures: Mapping[str, Path]) -> None:
    estimate, robot, config = run.estimate, run.experiment.robot, run.experiment.config
    epochs = estimate.epochs if isinstance(estimate, SgdEstimate) else None
    last = 1 if epochs is None else epochs
    with RunEvents(folder, robot.body_names, epochs is not None) as events:
        if epochs is None:
            for step, phi in enumerate((robot.nominal.flatten(), estimate.phi)):
                events.write_errors(step, {name: pair[step] for name, pair in run.metrics.items()})
                events.write_eigenvalues(step, body_eigenvalues(robot, phi))
            events.write_solution(estimate, None if run.factors else run.samples / run.seconds["compress"])
        else:  # what was not worked out by epoch
            for step, which in ((0, 0), (epochs, 1)):
                events.write_errors(step, {name: pair[which] for name, pair in run.metrics.items()}, (WHITENED,))
        if run.validation is not None:
            events.write_errors(0, {"left_out": run.validation.nominal})
            events.write_errors(last, {"left_out": run.validation.identified})
        if run.ridge is not None:
            events.write_ridges(run.ridge)
        events.write_verdict(last, describe_worse(run.worse) or "nowhere worse than the URDF's parameters")
        events.write_fit(last, estimate)
        events.write_identifiability(
            last, estimate, run.contributions.total, table_text(verdict_counts_table(run.by_state, estimate))
        )
        final = {
            f"{name}_{group}": value
            for name in reversed(SETS)  # test logs first: TensorBoard shows the first few
            if name in run.metrics
            for group, value in run.metrics[name].identified.relative.items()
            if value is not None
        }
        price = estimate.relative_increase if isinstance(estimate, ConstrainedEstimate) else 0.0
        final |= {"rank": float(estimate.rank)} | ({} if price is None else {"objective_above_least": price})
        events.write_summary(dump_config(config), _hyperparameters(config), final, figures, last)


def _hyperparameters(config: ExperimentConfig) -> dict[str, str | float | bool]:
    """The same keys for every estimator: TensorBoard compares runs by the keys of the first that it finds."""
    estimator, training = config.estimator, config.estimator.training
    descent = estimator.name == "sgd"
    return {
        "sensors": config.sensors.set or "by name",
        "estimator": estimator.name,
        "ridge": estimator.numeric_ridge,
        "friction": estimator.friction,
        "cutoff_hz": config.preprocessing.filter_hz or 0.0,
        "margin": 0.0 if estimator.name == "least_squares" else estimator.margin,
        "prior": estimator.prior,
        "consistency": estimator.consistency if descent else estimator.name,
        "optimizer": training.optimizer["name"] if descent else "none",
        "lr": float(training.optimizer.get("lr", 0.0)) if descent else 0.0,
        "schedule": (training.schedule or {}).get("name", "none") if descent else "none",
        "batch_size": training.batch_size if descent else 0,
        "epochs": training.epochs if descent else 0,
        "seed": training.seed if descent else 0,
    }
