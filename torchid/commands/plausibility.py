"""Whether a robot can have produced a fit: refuse or doubt it, with what the checks of the training logs find."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
from rich.progress import Progress, TaskID

from torchid import parameters
from torchid.commands.check import LogSegment, segments_to_check
from torchid.commands.chosen_settings import is_near_nominal, lower_cutoff, needs_these_torques
from torchid.commands.results import Results
from torchid.config import ExperimentConfig
from torchid.config.logs import LogsConfig
from torchid.errors import (
    ImplausibleFitError,
    InputError,
    NumericalWarning,
    SensorError,
    join_names,
    warn_about_file,
)
from torchid.estimators import LeastSquares, SgdEstimate
from torchid.fitting.experiment import RobotSetup, set_up
from torchid.fitting.fit import Fit
from torchid.fitting.noise import (
    beyond_noise,
    force_gain,
    unexplained_forces,
    unexplained_joints,
    unexplained_torques,
)
from torchid.identifiability.confounding import ExtraEstimate, TotalMass, estimate_extras, total_mass
from torchid.log_checks import Finding
from torchid.log_checks.check import check
from torchid.log_checks.equations import NominalModel
from torchid.log_checks.findings import SEVERITIES
from torchid.log_checks.unknowns import check_tilt
from torchid.parameters import GRAVITY, PARAMETERS, PER_BODY, Array
from torchid.problem import LinearProblem, Samples
from torchid.problem.metrics import ADVICE, Metrics, WorseThanNominal, describe_worse
from torchid.reading.log_reader import apply_contact_settings, setup_of_log
from torchid.robot import Robot
from torchid.sensing import SensorSet

LARGEST_FACTOR = 10.0
"""Factor that no model of a robot is off by: units are by a thousand, a gear by 50 to 160."""

_GENERAL = "weight"  # a finding that says that something is off rather than what
_PART = 0.05  # share of a log's samples from which on a finding may be the reason
#: Findings that say how a signal was recorded, which need not be why forces are not explained, or that they are not.
_NO_REASONS = ("dead band", "forces", "frozen", "gap", "held", "saturated", "spike", "step")
_USUAL = (
    "wrong signs, units, contact flags or quaternion order, a world z axis that points down, wrong masses in the {of}, "
    "rotors or a delay that actuators exclude, or noise (sensors.noise)"
)


class TrainingLogs:
    """The training logs of an experiment, checked once the first fit of them is doubtful."""

    def __init__(self, setup: RobotSetup, bars: Progress | None = None) -> None:
        """Nothing is checked yet; `bars`: gets one for the checks, which take a while for long logs."""
        self.setup = setup
        self._bars = bars or Progress(disable=True)

    @cached_property
    def finding(self) -> tuple[str, Finding] | None:
        """The most severe reason on a large part of a segment of a log, and the segment; None without any.

        Nothing after a segment that is rejected as a whole is looked at, nor are logs larger than memory.
        """
        files = self.setup.config.logs
        if files is None or files.compressed:
            return None
        task = self._bars.add_task("checking the logs", total=len(files.train))
        findings = list(self._findings(files, task))
        self._bars.update(task, completed=len(files.train))
        return min(findings, key=lambda pair: _order(pair[1]), default=None)

    def doubt(self, reason: str, refused: bool) -> str:
        """Refuse a fit, for a reason in any case or where a log cannot be used; else what the checks find, in words.

        Raises:
            ImplausibleFitError: names the reason, and the mistake that the checks find.
        """
        if self.finding is None:
            if refused:
                form = self.setup.robot.format
                lower = lower_cutoff(self.setup)
                band = "" if lower is None else f"preprocessing.cutoff_hz={lower}; or "
                accepted = f"{band}data and {form} that match; usual reasons: {_USUAL.format(of=form)}"
                raise ImplausibleFitError.at_field("logs", reason, _advice(accepted, self.setup))
            return ""
        log, finding = self.finding
        text = f"; torchid check finds in {log}: {finding.field}: {finding.found}"
        if refused or finding.rejects_all:
            raise ImplausibleFitError.at_field("logs", f"{reason}{text}", _advice(finding.advice, self.setup))
        return f"{text}; {finding.advice}"

    def _findings(self, files: LogsConfig, task: TaskID) -> Iterator[tuple[str, Finding]]:
        """Findings on large parts of segments."""
        for path in files.train:
            with suppress(InputError):  # larger than memory
                setup = setup_of_log(self.setup, path)
                for segment in segments_to_check(path, files, setup.config.preprocessing):
                    findings = _large_findings(setup, segment)
                    yield from ((segment.name, finding) for finding in findings)
                    if any(finding.rejects_all for finding in findings):
                        return
                    self._bars.advance(task, len(segment.log) / segment.of)


def _large_findings(setup: RobotSetup, segment: LogSegment) -> list[Finding]:
    """Reasons on a large part of a segment of a log, none where its contacts cannot be settled."""
    settings = setup.config.preprocessing
    try:
        flagged, _ = apply_contact_settings(segment.log, setup)
    except InputError:
        return []
    checked = check(flagged, setup.robot, setup.contacts, settings.filter_hz, settings.derived, setup.declared)
    severe = [finding for finding in checked.findings if finding.severity in SEVERITIES[:2]]
    reasons = [finding for finding in severe if finding.rejects_all or finding.name not in _NO_REASONS]
    return [finding for finding in reasons if finding.mask(len(checked.log)).mean() > _PART]


def require_plausible(
    fit: Fit, logs: TrainingLogs, samples: Sequence[Samples] = (), gain_error: float = 0.0
) -> TotalMass:
    """Refuse a fit that no robot can have produced, or that leaves most of the forces; warn of far more than noise.

    Args:
        fit: the fit.
        logs: that it is of.
        samples: of these, to look for the tilt of a bolted base in.
        gain_error: standard error of the total mass by errors of the sensors' gain [kg].

    Returns:
        How well the total mass is known.

    Raises:
        SensorError: no parameter is in reach of the sensors.
        ImplausibleFitError: forces that are all 0, parameters that no robot has, forces most of which no parameters
            explain, residuals far above the stated noise in a log that the checks reject, or scales that neither the
            data nor a known mass determines.

    Warns:
        NumericalWarning: residuals far above the stated noise.
        TorchidWarning: a bolted base that is tilted, which masses make up for in part.
    """
    estimate = fit.estimate
    setup = logs.setup
    if not estimate.rank:
        raise SensorError.at_field("sensors", "they determine no parameter", "other sensors, contacts or logs")
    if not max(fit.assembly.problem.cost(np.zeros_like(estimate.phi)), fit.assembly.forces) > 0.0:
        raise ImplausibleFitError.at_field("logs", "all measured forces are 0", "measured forces; NaN: not measured")
    block_error = 0.0 if fit.jackknife is None else fit.jackknife.mass_error
    tolerance = setup.config.estimator.rank_tolerance
    by_data = LeastSquares(rank_tolerance=tolerance).solve(fit.assembly.problem)
    if fit.assembly.homogeneous:
        by_data_alone = estimate_extras(fit.assembly, by_data, setup.robot.body_names, tolerance)
        _require_scales(by_data_alone, bool(setup.contacts))
    mass, mass_by_data = (total_mass(fit.assembly, x, tolerance, block_error, gain_error) for x in (estimate, by_data))
    reason = implausibility(fit.assembly.data or fit.assembly.problem, estimate.phi, mass_by_data, setup.robot)
    if _is_held(setup, force_gain(fit.assembly.if_known)):
        refusal = "the torques do not carry the robot's weight: is its base held?"
        accepted = "robot.fixed_base: true, without contacts and preprocessing.base_motion"
        raise ImplausibleFitError.at_field("preprocessing.base_motion", refusal, accepted)
    beyond = ""
    if not isinstance(estimate, SgdEstimate):  # a descent that is not finished leaves much that a model explains
        reason = reason or unexplained_forces(estimate, fit.assembly.problem, fit.assembly.forces, setup.noise_stated)
        beyond = beyond_noise(estimate) if setup.noise_stated else ""
    if reason:
        logs.doubt(reason, refused=True)
    if beyond:
        advice = ". Check units, frames, quaternion order and contact_active, or state a larger noise."
        warn_about_file(f"{beyond}{logs.doubt(beyond, refused=False) or advice}", NumericalWarning)
    else:
        _warn_of_tilt(samples, setup)
    return mass


def _advice(text: str, setup: RobotSetup) -> str:
    """What to do, first of all where nothing holds the robot: then masses of 0 explain forces of no weight."""
    if setup.contacts or setup.robot.fixed_base or "under contacts" in text:
        return text
    return f"contacts with the ground, or robot.fixed_base: true if the base stands still; or {text}"


def _is_held(setup: RobotSetup, gain: float | None) -> bool:
    """Whether a base whose motion is that of the feet is held instead, as the torques say; `gain`: as it is fitted."""
    config = setup.config
    if config.preprocessing.base_motion is None or not isinstance(config, ExperimentConfig) or is_near_nominal(gain):
        return False
    read = replace(config.preprocessing, base_motion=None, detect_contacts=None, contact_threshold=None, max_slip=None)
    held = replace(config, robot=replace(config.robot, fixed_base=True), contacts=[], preprocessing=read)
    return needs_these_torques(set_up(held))


def _warn_of_tilt(samples: Sequence[Samples], setup: RobotSetup) -> None:
    """Say that a bolted base which counts as upright is tilted."""
    if samples and setup.robot.fixed_base and setup.config.robot.base_tilt is None:
        for finding in check_tilt(samples, NominalModel(setup.robot, setup.contacts, setup.declared)):
            warn_about_file(f"robot.base_tilt: {finding.found}; {finding.advice}")


def _require_scales(by_data: Sequence[ExtraEstimate], has_contacts: bool) -> None:
    """Refuse scales of all measured forces where no forces at all, with mass where it acts on none, fit best.

    Args:
        by_data: extra parameters by the data and known masses alone: a ridge would hide where they go.
        has_contacts: whether the robot has any.

    Raises:
        ImplausibleFitError: names them.
    """
    scales = {x.extra.label: 1.0 + x.value for x in by_data if x.extra.what == "scale"}
    beyond = [f"{label} {x:.2g}" for label, x in scales.items() if is_implausible_factor(x)]
    if beyond:
        refusal = f"the data do not determine scales of all measured forces: {join_names(beyond)}"
        accepted = "a sensor without a scale, or known estimator.masses that load it"
        if has_contacts:
            reason = "else mass at a standing contact loads no joint"
            accepted = f"a sensor without a scale, or logs in which each contact lifts off: {reason}"
        raise ImplausibleFitError.at_field("sensors.scales", refusal, accepted)


def require_not_worse(worse: list[WorseThanNominal], fitted: Metrics, sensors: SensorSet, logs: TrainingLogs) -> None:
    """Refuse a fit that leaves most of the torques, or predicts worse than the URDF and the checks reject a log.

    Args:
        worse: groups of rows that the URDF predicts better.
        fitted: errors of the fit on the training logs.
        sensors: of the fit.
        logs: these.

    Raises:
        ImplausibleFitError: torques that are not explained, or the parameters of a log that is not usable.

    Warns:
        NumericalWarning: the URDF's parameters predict better, for whatever reason.
    """
    if unexplained := unexplained_torques(fitted, sensors):
        logs.doubt(unexplained, refused=True)
    if message := describe_worse(worse, logs.setup.robot.format):
        warn_about_file(f"{message}{logs.doubt(message, refused=False) or f'. {ADVICE}'}", NumericalWarning)


def suspected_mistake(run: Results, logs: TrainingLogs) -> str:
    """What the checks find in the training logs where a fit is doubtful, in words; "" where it is not, or they do not.

    A fit is doubtful if its bodies are far off the robot's file, or if it leaves a large part of a joint's torque:
    masses make up for an encoder that is off or in degrees, and noise that is estimated for a torque of another gear.

    Args:
        run: a finished run.
        logs: that it is of.

    Raises:
        ImplausibleFitError: forces that the model does not explain, with bodies far off the robot's file, of a log that
            the checks reject.
    """
    nominal = run.posterior.nominal_error
    fitted = run.metrics["train"].identified
    is_far_off = nominal is not None and nominal.prior_is_narrow
    joints = unexplained_joints(fitted) if run.experiment.robot.fixed_base else []
    if not is_far_off and not joints:
        return ""
    if logs.finding is None or not logs.finding[1].whole:  # some samples are no reason for parameters
        return ""
    reason = f"{nominal}, and the model does not explain these forces"
    if is_far_off and not run.misfit.explained:
        logs.doubt(reason, refused=False)
    log, finding = logs.finding
    return f"{log}: {finding.field}: {finding.found}; {finding.advice}"


def implausibility(problem: LinearProblem, phi: Array, mass: TotalMass, robot: Robot) -> str | None:
    """Why fitted parameters cannot be those of the robot, None if they can.

    What the data do not determine is no reason: it is not printed as a result.

    Args:
        problem: that was solved.
        phi: (12 L,), its solution.
        mass: by the data alone: a ridge and conditions would hide that they want another.
        robot: the robot.
    """
    gain = force_gain(problem)
    if mass.determined and is_implausible_factor(mass.value / mass.nominal):
        known = f"{mass.value:.4g} ± {mass.standard_error:.2g} kg ({robot.format}: {mass.nominal:.4g} kg)"
        return f"the fitted total mass is {known}{_sign_note(mass.value / mass.nominal)}"
    if gain is not None and is_implausible_factor(gain):
        return f"the measured forces are {gain:.3g} times those that the {robot.format} needs{_sign_note(gain)}"
    return next(_beyond_bounds(phi.reshape(-1, PER_BODY), robot), None)


def is_implausible_factor(ratio: float) -> bool:
    """Whether no model of a robot is off by this factor."""
    return not 1.0 / LARGEST_FACTOR <= ratio <= LARGEST_FACTOR


def _sign_note(ratio: float) -> str:
    return ", the opposite sign" if ratio < 0.0 else ""


def _beyond_bounds(phi: Array, robot: Robot) -> Iterator[str]:
    """Parameters, (L, 12), that are beyond what `LARGEST_FACTOR` whole robots at full reach could make of one body."""
    total = float(robot.nominal[:, parameters.MASS].sum())
    reach = _reach(robot)
    bound = np.empty(PER_BODY)
    bound[parameters.MASS] = total
    bound[parameters.FIRST_MOMENT] = total * reach
    bound[parameters.INERTIA], bound[parameters.FRICTION] = total * reach**2, total * GRAVITY * max(reach, 1.0)
    beyond = ~(np.abs(phi) <= LARGEST_FACTOR * np.maximum(bound, np.abs(robot.nominal)))
    for body, parameter in np.argwhere(beyond):
        fitted = f"{robot.body_names[body]} has {PARAMETERS[parameter]} = {phi[body, parameter]:.3g}"
        yield f"the fit's {fitted}, over {LARGEST_FACTOR:g} times the whole {robot.format}'s {bound[parameter]:.3g}"


def _reach(robot: Robot) -> float:
    """Length of the longest chain of bodies [m], with the size of its last."""
    mass = np.maximum(robot.nominal[:, parameters.MASS], np.finfo(float).tiny)
    radius = np.sqrt(np.maximum(np.trace(parameters.inertia_matrix(robot.nominal), axis1=1, axis2=2) / 2.0 / mass, 0.0))
    radius[robot.nominal[:, parameters.MASS] <= 0.0] = 0.0
    away = np.zeros(len(robot.bodies))
    for number, body in enumerate(robot.bodies):
        if body.joint is not None:
            away[number] = away[body.parent] + np.linalg.norm(body.joint.T_parent_joint[:3, 3])
    return float((away + radius).max())


def _order(finding: Finding) -> tuple[int, bool, bool]:
    return SEVERITIES.index(finding.severity), not finding.whole, finding.name == _GENERAL
