"""What a finished identification holds, and the folder it is written to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchid.commands.chosen_settings import Choices
from torchid.commands.folder import RUN, check_free, check_free_file, new_folder, write_json
from torchid.commands.named_results import BodyEstimate, ParameterTable, body_estimate, parameter_table, run_lines
from torchid.commands.report import DATA, report_document, write_page
from torchid.commands.run_figures import draw_figures, write_events
from torchid.commands.training import Training, body_eigenvalues
from torchid.config import dump_config, inputs_of
from torchid.errors import during
from torchid.estimators import ConstrainedEstimate, Estimate, Violation
from torchid.fitting.calibration import Comparison, list_confounded
from torchid.fitting.cross_validation import CrossValidation, RidgeChoice
from torchid.fitting.experiment import Experiment
from torchid.fitting.factor_files import FactorFile
from torchid.fitting.noise import Misfit, NoiseSummary
from torchid.fitting.posterior import POSTERIOR, RESIDUAL, FittedPosterior, RigidPlusResidual, write_posterior
from torchid.fitting.robust import RobustSummary
from torchid.identifiability.base_parameters import StateReport
from torchid.identifiability.confounding import ExtraEstimate, TotalMass
from torchid.identifiability.information import Contributions
from torchid.logs.containers import atomic_output
from torchid.parameters import PER_BODY, Array
from torchid.problem import Metrics
from torchid.problem.extras import NoiseGroups
from torchid.problem.metrics import LOG_SETS, WorseThanNominal, describe_worse, worse_than_nominal
from torchid.problem.noise_gram import NoiseShares
from torchid.report import FittedJoints, identified_name, identified_robot, identified_urdf, parameters_document
from torchid.report.forces import ForceSeries, LogForces
from torchid.report.robot_files import refused_by_simulators

HELD_OUT = "blocks left out of the fit"
"""Name of the training samples that cross-validation predicts, in messages."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Identification:
    """A finished run; `run["l_knee"]` is what it says of a body, by its name or that of its joint.

    Attributes:
        experiment: robot, contacts, sensors and settings, with the noise and the ridge that were used.
        estimate: the fit.
        extras: offsets, scales and actuator terms.
        noise: that rows were weighted with.
        motion_noise: what noise of the motion had added to the normal equations.
        misfit: what the fit leaves of the forces, and what noise would leave.
        resting: share of the time at rest of joints that rest often, where friction goes with the sign of velocities or
            torques then count as unmeasured.
        at_rest: sets of logs, "train" and "test", in which nothing moves.
        robust: how outliers were down-weighted, if so.
        states: contact states of the training logs.
        by_state: what each of them determines on its own.
        contributions: what each training log, contact state and sensor adds.
        metrics: errors by set of logs, "train" and "test".
        evaluated: number of samples whose forces were predicted, by set of logs.
        violations: conditions that the identified parameters break.
        seconds: by step of the run.
        samples: number of training samples.
        factors: the training logs, where they came compressed.
        excluded: rejected samples left out, by log.
        mass: the total mass and how well it is known.
        posterior: of the parameters, which `PosteriorSampler` draws from.
        validation: errors on held-out blocks, None where the samples are too few to leave some out.
        ridge: how it was chosen, if it was.
        choices: how other settings were chosen, if they were.
        forces: of the first samples of a log, as measured and as predicted; None where there are but factors.
        traces: of all of that log, in the rows of the fit.
        suspected: what the checks find in its training logs if it is doubtful, in words.
    """

    experiment: Experiment
    estimate: Estimate
    extras: list[ExtraEstimate]
    noise: NoiseSummary
    motion_noise: NoiseShares
    misfit: Misfit
    resting: Mapping[str, float]
    at_rest: Sequence[str]
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
    posterior: FittedPosterior
    validation: CrossValidation | None
    ridge: RidgeChoice | None
    choices: Choices
    forces: ForceSeries | None
    traces: LogForces | None
    suspected: str = ""

    def __getitem__(self, name: str) -> BodyEstimate:
        """Identified parameters of a body, by its name, or else by that of its joint or of any link of it.

        Raises:
            UnknownNameError: the robot has neither.
        """
        return body_estimate(self.experiment.robot, self.estimate, name)

    def __iter__(self) -> Iterator[str]:
        """Names of the bodies."""
        return iter(self.experiment.robot.body_names)

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.experiment.robot.bodies)

    def __repr__(self) -> str:
        return "\n".join(run_lines(self))

    def table(self) -> ParameterTable:
        """All parameters of all bodies, one per row; `pandas.DataFrame` takes it."""
        return parameter_table(self.experiment.robot, self.estimate)

    def to_dict(self) -> dict[str, Any]:
        """What a run folder has in `parameters.json`, `metrics.json` and `config.yaml`."""
        parameters = parameters_document(self.experiment.robot, self.estimate, self.by_state, self.extras)
        config = yaml.safe_load(dump_config(self.experiment.config))
        return {"parameters": parameters, "metrics": _metrics_document(self), "config": config}

    def to_urdf(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the URDF with the identified parameters; meshes keep their names.

        Raises:
            ConfigError: the file exists and `overwrite` is not set, or it is an input.

        Warns:
            TorchidWarning: bodies that cannot exist.
        """
        inputs = inputs_of(self.experiment.config)
        check_free_file(path := Path(path), "path", overwrite, inputs, "overwrite=True")
        with atomic_output(path) as new:
            new.write_bytes(identified_urdf(self.experiment.robot, self.phi))
        return path

    def write(self, output: str | Path, overwrite: bool = False, learned: RigidPlusResidual | None = None) -> Path:
        """Write the run folder that `torchid identify` writes, and what was learned beside, which `evaluate` takes up.

        Raises:
            ConfigError: the folder exists and may not be replaced.
        """
        check_free(path := Path(output).absolute(), overwrite, RUN, inputs_of(self.experiment.config))
        write_run(self, path, overwrite, learned=learned)
        return path

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
    def fitted_joints(self) -> FittedJoints:
        """What was fitted of joints beside friction."""
        return FittedJoints.of((x.extra, x.value) for x in self.extras)

    @cached_property
    def refused(self) -> str:
        """Why simulators refuse the robot's file with the identified parameters, "" if they take it."""
        return refused_by_simulators(self.experiment.robot, self.phi, self.fitted_joints)

    @property
    def phi(self) -> Array:
        """Identified parameters, (L, 12)."""
        return self.estimate.phi.reshape(-1, PER_BODY)


def write_run(
    run: Identification,
    output: Path,
    overwrite: bool = False,
    training: Training | None = None,
    learned: RigidPlusResidual | None = None,
) -> None:
    """Write the run folder.

    Args:
        run: what to write.
        output: the folder.
        overwrite: whether a run that stands there may be replaced.
        training: whose curves go into the folder, and whose checkpoint is then no longer needed.
        learned: a module beside the rigid bodies, with its parameters of these.

    Raises:
        ConfigError: the folder exists and may not be replaced.
    """
    config, robot = replace(run.experiment.config, output=output), run.experiment.robot
    run = replace(run, experiment=replace(run.experiment, config=config))
    with during("writing", output), new_folder(output, overwrite) as folder:
        (folder / "config.yaml").write_text(dump_config(config))
        write_json(folder / "parameters.json", parameters_document(robot, run.estimate, run.by_state, run.extras))
        write_json(folder / "metrics.json", _metrics_document(run))
        if learned is not None:
            learned.save(folder / RESIDUAL)
        write_posterior(folder / POSTERIOR, run.posterior)
        (folder / identified_name(robot)).write_bytes(identified_robot(robot, run.phi, run.fitted_joints))
        write_json(folder / DATA, report_document(run))
        if training is not None:
            training.copy_curves(folder)
        write_events(run, folder, draw_figures(run, folder))
        write_page(folder, output)
    if training is not None:
        training.remove_checkpoint()


def _metrics_document(run: Identification) -> dict[str, object]:
    """What `metrics.json` holds: errors of the identified and of the nominal parameters."""
    estimate, robot = run.estimate, run.experiment.robot
    document: dict[str, object] = {}
    for name in LOG_SETS:
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
        "contacts": run.experiment.rolling,
        "evaluated_samples": dict(run.evaluated),
        "excluded_samples": run.excluded,
        **({"factors": list(map(_factor_entry, run.factors))} if run.factors else {}),
        "rows": estimate.rows,
        "residual_std": estimate.residual_std,
        "misfit": _misfit_document(run.misfit),
        "resting_joints": dict(run.resting),
        "at_rest": list(run.at_rest),
        "motion_noise": asdict(run.motion_noise),
        "nominal_error": None if run.posterior.nominal_error is None else asdict(run.posterior.nominal_error),
        "total_mass": run.mass.value if run.mass.determined else None,
        "total_mass_standard_error": run.mass.standard_error if np.isfinite(run.mass.standard_error) else None,
        "total_mass_separable_from_offsets": run.mass.separable,
        "confounded": [asdict(one) | {"message": str(one)} for one in list_confounded(run.extras)],
        "total_mass_nominal": float(robot.nominal[:, 0].sum()),
        "smallest_eigenvalue": body_eigenvalues(robot, estimate.phi),
        "noise": {
            "groups": [asdict(one) for one in run.noise.groups],
            "used": NoiseGroups.of(robot).settings(run.noise.known),
            "suggested": run.noise.suggested,
        },
        "robust": None if run.robust is None else asdict(run.robust),
        "violations": run.violations_by_name(),
        "solution": _solution_document(estimate),
        "cross_validation": None
        if run.validation is None
        else {
            "folds": run.validation.folds,
            "nominal": run.validation.nominal.as_dict(),
            "identified": run.validation.identified.as_dict(),
        },
        "ridge_selection": None if run.ridge is None else asdict(run.ridge),
        **{f"{name}_selection": x and asdict(x) for name, x in vars(run.choices).items()},
        "worse_than_nominal": [asdict(one) for one in run.worse],
        "verdict": describe_worse(run.worse, robot.format),
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
        "unfitted_friction": None if misfit.friction is None else misfit.friction.ratio,
    }


def _factor_entry(factors: FactorFile) -> dict[str, object]:
    """Which log a file of factors is of."""
    log = factors.log
    names = {"file": log.source, "log": factors.name, "sha256": factors.sha256, "torchid": factors.version}
    return names | {"samples": log.samples, "duration_s": factors.duration}


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


def _solution_document(estimate: Estimate) -> dict[str, object] | None:
    """What is known of the optimum, or of the descent."""
    if not isinstance(estimate, ConstrainedEstimate):
        return None
    names = ["objective", "unconstrained", "distance", "gap", "steps", "active", "epochs", "best_epoch", "excess"]
    return {name: getattr(estimate, name) for name in names if hasattr(estimate, name)}
