"""The answer of a run in words: did it work, what is the model, what needs attention."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten

import numpy as np

from torchid.commands.results import Results
from torchid.config.logs import tests_on_seen_samples
from torchid.errors import format_count, format_percent, join_names
from torchid.estimators import ConsistentEstimate, Estimate, SgdEstimate
from torchid.estimators.least_squares import IDENTIFIED
from torchid.fitting.fit import Comparison, list_confounded
from torchid.fitting.noise import AT_THE_FLOOR, unexplained_joints
from torchid.fitting.posterior import FittedPosterior
from torchid.log_checks.contacts import MAX_MASS_ERROR
from torchid.logs.columns import values_by_name
from torchid.logs.time_range import log_title
from torchid.parameters import COULOMB, PER_BODY
from torchid.problem import Metrics
from torchid.problem.metrics import (
    ADVICE,
    DECISIVE_GROUPS,
    ERROR_GROUPS,
    LIMB_GROUPS,
    PRESSURE,
    compare_parts,
    describe_errors,
    describe_worse,
    group_name,
)
from torchid.report.tables import noise_advice
from torchid.report.urdf_files import massless_ends
from torchid.reprs import decimal

_FEW_GROUPS = 2
_FEW_NAMED = 4
_WIDTH = 108  # of a line of a summary
#: By the least and the largest error of a group of rows, as shares of the URDF's.
_VERDICTS = {
    (0.5, 0.5): "Much better",
    (0.95, 0.95): "Better",
    (0.95, np.inf): "Partly better",
    (np.inf, np.inf): "No better",
}


@dataclass(frozen=True)
class ErrorComparison:
    """Errors of nominal and of identified parameters.

    Attributes:
        text: where the motion is from.
        nominal: errors of the nominal parameters.
        identified: likewise.
        of: what the nominal parameters are those of, "URDF" or "MJCF".
        at_rest: whether nothing moves there.
    """

    text: str
    nominal: Metrics
    identified: Metrics
    of: str
    at_rest: bool = False

    def errors(self, groups: Sequence[str] = DECISIVE_GROUPS) -> Iterator[tuple[str, float, float, float | None]]:
        """Groups of rows with both errors, and what noise of the readings leaves."""
        for group in groups:
            before = self.nominal.rms_of(group)
            after = self.identified.rms_of(group)
            if before is not None and after is not None:
                yield group, before, after, self.identified.noise.get(group)

    def headline(self, explained: bool = True) -> str:
        """The verdict in a sentence or two; `explained`: whether the model explains the forces of the fit."""
        ratios = [after / before if before else 1.0 for _, before, after, _ in self.errors()]
        if not ratios:
            return f"No measured forces to compare with the {self.of} on {self.text}."
        least = min(ratios)
        most = max(ratios)
        error = f"the error is {times_smaller(most if most <= 1.1 * least else least, most)}"
        known = [after / floor for _, _, after, floor in self.errors() if floor]
        if known and max(known) < AT_THE_FLOOR:
            error += ", as small as the noise floor"
        if not explained:
            return f"The model does not explain these forces. Compared with the {self.of} on {self.text}, {error}."
        if self.at_rest:
            still = f"Nothing moves in {self.text}: inertia and friction are not judged"
            return f"{still}. Compared with the {self.of}, {error}."
        better, parts, worse = compare_parts(self.nominal, self.identified)
        if worse:
            where = f"better in {better} of {parts} joints and base axes, worse in {join_names(worse, 1)}"
            return f"Mixed, compared with the {self.of} on {self.text}: {where}."
        verdict = next(text for limits, text in _VERDICTS.items() if least < limits[0] and most < limits[1])
        return f"{verdict} than the {self.of} on {self.text}: {error}."

    def shown_errors(self) -> list[tuple[str, float, float, float | None]]:
        """Errors that a user should see, by the words for their group, with units."""
        few = len(list(self.errors())) < _FEW_GROUPS  # no joint of its own, as all legs stand: their projection
        errors = self.errors((*(ERROR_GROUPS if few else DECISIVE_GROUPS), PRESSURE))
        return [(self.identified.label(group), before, after, floor) for group, before, after, floor in errors]


def times_smaller(least: float, most: float) -> str:
    """The least and the largest ratio of errors in words, as "4 to 14 times smaller"."""

    def factors(*ratios: float) -> str:
        texts = [f"{x:.{2 + (x < 1.995)}g}" if x < 99.5 else f"{x:.0f}" if x < 1e3 else "over 1000" for x in ratios]
        return f"{' to '.join(dict.fromkeys(texts))} times"

    most_smaller = 1.0 / max(least, _EXACT_SHARE**2)
    if most < 1.0:
        return f"{factors(1.0 / most, most_smaller)} smaller"
    larger = f"{factors(*(least, most) if least >= 1.0 else (most,))} larger"
    return larger if least >= 1.0 else f"{larger} to {factors(most_smaller)} smaller"


_LARGER_THAN_MEASURED = 1.05  # errors over the measured, of sensors that any fit of their limb explains better
_MUCH_MORE = 1.5  # residuals of bodies that can exist over the least: 1.001 of honest logs, 1.9 to 30 with a unit wrong
_EXACT_SHARE = 1e-3  # of what the nominal parameters leave: signals without noise, of which rounding is left
_CLEAR_ERRORS = 4.0  # standard errors of a total mass from which on it is not the URDF's
_HEAVY = 2.0  # times the mass in the robot's file
_COMPUTED = 1e-3  # of the measured, to which no file predicts what a real robot does: friction alone is more
_ALIKE = 0.2  # relative differences of armatures over kd, below which they are one time
_DIFFERENT = 1.5  # ratio of gains
_SAME_STEP = 0.1  # relative difference of two steps of time
_ANOTHER_ROBOT = 1.0  # of each body that data determine: no file of the same robot is off by so much


@dataclass(frozen=True)
class Answer:
    """What a run says first.

    Attributes:
        headline: how much better than the URDF it predicts.
        errors: groups of rows with the rms errors of the URDF's and of the identified parameters, and what noise of the
            readings leaves, None where it is not known.
        total_mass: with its standard error, beside the URDF's.
        bodies: whether all are physically consistent.
        attention: what the user should look at, the most urgent first.
        terms: of the actuators that the logs have chosen, "" where they chose none of their own.
    """

    headline: str
    errors: list[tuple[str, float, float, float | None]]
    total_mass: str
    bodies: str
    attention: list[str]
    terms: str = ""


def answer(run: Results) -> Answer:
    """The answer of a finished run."""
    judged = _judge(run)
    explained = not any((*_unlike_sensors(judged.identified), *_unlike_joints(run)))
    return Answer(
        headline=describe_worse(run.worse, judged.of) or judged.headline(explained),
        errors=judged.shown_errors(),
        total_mass=_total_mass(run),
        bodies=_bodies_text(run),
        attention=list(_attention(run, judged)),
        terms=run.choices.adopted,
    )


def summary_lines(run: Results) -> list[str]:
    """What a run is and found, in at most ten lines."""
    robot = run.experiment.robot
    estimate = run.estimate
    config = run.experiment.config
    counts = ", ".join(f"{count} {verdict}" for verdict, count in estimate.verdict_counts().items() if count)
    said = [("data", f"{format_count(run.samples, 'sample')} of {format_count(len(config.logs.train), 'log')}")]
    said += [("parameters", f"{estimate.phi.size}: {counts}")]
    if not robot.fixed_base:
        said.append(("total mass", _total_mass(run)))
    sets = {name: (pair.identified, pair.nominal) for name, pair in run.metrics.items()}
    if run.validation is not None:
        sets["left out"] = (run.validation.identified, run.validation.nominal)
    said += [(name, describe_errors(nominal, identified)) for name, (identified, nominal) in sets.items()]
    trouble = filter(None, [describe_worse(run.worse, robot.format), str(run.misfit)])
    said += [("attention", text)] if (text := "; ".join(trouble)) else []
    said.append(("written to", str(config.output or "no folder: write(folder), to_urdf(file)")))
    title = f"{robot.path.name}, {len(run)} bodies, {format_count(robot.n, 'joint')}, by {config.estimator.name}"
    lines = (f"{label:12}{shorten(text, _WIDTH, placeholder=' ...')}" for label, text in said)
    return [f"Identification of {title}", *lines]


def _total_mass(run: Results) -> str:
    gain = run.experiment.config.sensors.gain_error
    file_kind = run.experiment.robot.format
    counted = run.mass.determined and run.estimate.gain_error is not None and run.estimate.gain_error.any()
    error = "; 1 sigma" if run.mass.determined else ""
    gains = f", with {100.0 * gain:g} % gain error" if counted else ""
    return f"{run.mass} ({file_kind}: {decimal(run.mass.nominal)} kg{error}{gains})"


def _judge(run: Results) -> ErrorComparison:
    name = "test" if "test" in run.metrics else "train"
    pair = run.metrics[name]
    at_rest = name in run.at_rest
    text = "the training logs themselves"
    if name == "test":
        files = run.experiment.config.logs
        motion = "training motion" if tests_on_seen_samples(files) else "unseen motion"
        text = f"{'the test logs' if at_rest else motion} ({join_names([log_title(path) for path in files.test], 2)})"
    elif run.validation is not None:
        pair = Comparison(run.validation.nominal, run.validation.identified)
        text = f"{run.validation.folds} held-out blocks of the training logs"
    return ErrorComparison(text, pair.nominal, pair.identified, run.experiment.robot.format, at_rest)


def _bodies_text(run: Results) -> str:
    robot = run.experiment.robot
    count = len(robot.body_names)
    if all(violation.term is not None for violation in run.violations):
        ends = massless_ends(robot, run.phi)
        if ends:
            return f"physically consistent, but MuJoCo refuses joints that move no mass: {join_names(ends)}"
        if run.refused:
            return f"all {count} physically consistent, but MuJoCo refuses the file: {run.refused}"
        return f"all {count} physically consistent"
    bodies = {violation.body for violation in run.violations} - {None}
    which = f"{len(bodies)} of {count}" if bodies else "all together"
    advice = ". Use estimator.name=consistent" if type(run.estimate) is Estimate else ""
    return f"{which} not physically consistent; simulators refuse them{advice}"


def _attention(run: Results, judged: ErrorComparison) -> Iterator[str]:
    """What the user should look at: conditions with what they mean and what to do, the most urgent first."""
    mass = run.mass
    file_kind = run.experiment.robot.format
    estimate = run.estimate
    terms = [violation.term for violation in run.violations if violation.term is not None]
    least = estimate.relative_increase if isinstance(estimate, ConsistentEstimate) else None
    growth = np.sqrt(1.0 + (least or 0.0))
    ratio = mass.value / mass.nominal if mass.nominal else np.nan
    is_clear = abs(mass.value - mass.nominal) > _CLEAR_ERRORS * mass.standard_error
    is_off = abs(mass.value - mass.nominal) > MAX_MASS_ERROR * mass.nominal
    contradicts = run.experiment.config.estimator.total_mass is None and mass.determined and is_clear and is_off
    is_open = not mass.determined and (is_off or not run.experiment.robot.fixed_base)
    fitted = f" (the fit: {decimal(mass.value)} kg, {file_kind}: {decimal(mass.nominal)} kg)" * is_off
    adopted = run.choices.adopted_terms
    independent = f"{run.samples / estimate.oversampling:.0f} independent samples"
    unfinished = list(_unfinished(estimate))
    rules = (
        (bool(run.worse), ADVICE),
        (bool(run.suspected), f"torchid check finds in {run.suspected}"),
        *((True, text) for text in unfinished),
        *((True, text) for text in _unlike_sensors(judged.identified)),
        *((True, text) for text in _computed(judged)),
        (bool(terms), f"The fit makes {join_names(terms)} negative: impossible. Use estimator.name=consistent."),
        (growth > _MUCH_MORE and (run.misfit.share or 0.0) > _EXACT_SHARE,
         f"No physically consistent bodies explain these forces: their residuals are {growth:.2g} times those of other "
         "bodies. Check unit, gear and sign of the torques: torchid check."),
        *((True, text) for text in _driving(run)),
        *((True, text) for text in _unlike_joints(run)),
        *((True, text) for text in _heavy(run)),
        (not run.misfit.explained and not unfinished,
         f"Friction, compliance or contacts are missing, or a sensor is wrong (torchid check): {run.misfit.in_short}"),
        *((True, text) for text in _resting(run)),
        (contradicts, f"The total mass is {ratio:.3g} times the {file_kind}'s. Weigh the robot, or correct units and "
                      "gains of forces: torchid check."),
        (not run.misfit.judged,
         "It is unknown whether the model explains these forces: no noise is stated, and the logs are too short. State "
         "sensors.noise, or record more."),
        (estimate.block_error is None,
         f"95 % intervals include noise only, no model errors: {independent} are too few. Record more."),
        (is_open, f"These data do not determine the total mass{fitted}. Weigh the robot: estimator.total_mass."),
        *((True, text) for text in _implicit(run)),
        *((True, x.in_short) for x in list_confounded([x for x in run.extras if x.extra.what not in adopted])),
        *((True, text) for text in _far_off(run.posterior)),
        (bool(run.noise.suggested), noise_advice(run.noise.suggested)),
    )  # fmt: skip
    return (text for applies, text in rules if applies)


def _unfinished(estimate: Estimate) -> Iterator[str]:
    """How far above the optimum a descent ended."""
    if isinstance(estimate, SgdEstimate) and not estimate.converged:
        above = "" if estimate.excess is None else f": {100.0 * estimate.excess:.2g} % above the optimum"
        yield f"Not converged{above}. Raise estimator.training.epochs, or use estimator.name=consistent."


def _resting(run: Results) -> Iterator[str]:
    """That joints rest where forces are not explained, or all the time where actuators.stiction leaves out rest."""
    if run.experiment.config.actuators.stiction:
        if still := [name for name, share in run.resting.items() if share == 1.0]:
            yield (
                f"No friction is identified of {join_names(still, _FEW_NAMED)}: they always rest, or almost, and "
                "actuators.stiction leaves out joints at rest. Record more motion."
            )
    elif run.resting and not run.misfit.explained:
        names = join_names([f"{name} {100.0 * share:.0f} %" for name, share in run.resting.items()], _FEW_NAMED)
        yield f"Friction is underestimated, as joints rest ({names}). Set actuators.stiction=true."


def _unlike_sensors(identified: Metrics) -> Iterator[str]:
    """Readings that the identified parameters predict worse than no bodies, or a constant base force, would."""
    for group in (*LIMB_GROUPS, "nullspace"):
        share = identified.relative_of(group)
        if share is not None and share > _LARGER_THAN_MEASURED:
            what = "sign, unit and frame of the sensor" if group in LIMB_GROUPS else "signs, units and order of joints"
            name = group_name(group)
            yield f"The error of the {name} is {share:.2g} times the measured value. Check {what}: torchid check."
    share = identified.base_force_of_variation
    of_weight = identified.relative_of("base_force")
    if share is not None and share > _LARGER_THAN_MEASURED and (of_weight or 0.0) > MAX_MASS_ERROR:
        yield (
            f"The error of the base force is {share:.2g} times the variation of its measured value. Check frames, "
            "signs and units of contact forces and base pose: torchid check."
        )


def _computed(judged: ErrorComparison) -> Iterator[str]:
    """That the robot's file itself predicts the forces better than is possible for a real robot."""
    shares = [share for group in ERROR_GROUPS if (share := judged.nominal.relative_of(group)) is not None]
    if shares and max(shares) < _COMPUTED:
        to = f"to {format_percent(max(shares))} %"
        yield f"The {judged.of} predicts these forces {to}. Are they computed from it, or commands, not measurements?"


def _heavy(run: Results) -> Iterator[str]:
    """Bodies beyond `_HEAVY` times their mass in the robot's file, which their own interval does not exclude."""
    robot = run.experiment.robot
    estimate = run.estimate
    mass, error = (x.reshape(-1, PER_BODY)[:, 0] for x in (estimate.phi, estimate.standard_error))
    nominal = robot.nominal[:, 0]
    known = (estimate.verdict.reshape(-1, PER_BODY)[:, 0] == IDENTIFIED) & (mass - nominal > 2.0 * error)
    heavy = np.flatnonzero((mass > _HEAVY * nominal) & (nominal > 0.0) & ~known)
    ratio = mass[heavy] / nominal[heavy]
    if named := [f"{robot.body_names[heavy[k]]} {ratio[k]:.2g} times" for k in np.argsort(-ratio)]:
        yield (
            f"Masses that the data do not determine are large: {join_names(named, _FEW_NAMED)} the {robot.format}'s. "
            f"Raise estimator.ridge above {run.experiment.config.estimator.ridge}."
        )


def _driving(run: Results) -> Iterator[str]:
    """That Coulomb friction is negative far beyond its standard errors, which least squares lets it be."""
    value, error = (x.reshape(-1, PER_BODY)[:, COULOMB] for x in (run.estimate.phi, run.estimate.standard_error))
    bodies = np.array(run.experiment.robot.bodies, object)[value < -_CLEAR_ERRORS * error]
    if len(bodies) and (run.misfit.share or 0.0) > _EXACT_SHARE:
        names = join_names([body.joint.name for body in bodies], _FEW_NAMED)
        yield (
            f"The Coulomb friction of {names} is negative: the torque is reversed, or friction has another shape. Run "
            "torchid check."
        )


def _implicit(run: Results) -> Iterator[str]:
    """That armatures come from a simulator's implicit integration of a PD law, where its kd is stated."""
    logs = run.experiment.config.logs
    robot = run.experiment.robot
    torque = logs.columns.joint_torque if logs.columns else None
    if run.forces is None or torque is None or torque.pd is None or torque.pd.kd is None:
        return
    kd = values_by_name("logs.columns.joint_torque.pd.kd", torque.pd.kd.value, robot.joint_names)
    known = dict(zip(robot.joint_names, robot.armature.tolist(), strict=True))
    added = {x.extra.name: x.value - known[x.extra.name] for x in run.extras if x.extra.what == "armature"}
    if step := implicit_step(kd, added, 1.0 / run.forces.rate):
        yield (
            f"Armatures are {1e3 * step:.2g} ms times the stated kd: they come from a simulator's implicit PD law, not "
            "from rotors."
        )


def implicit_step(kd: Mapping[str, float], armatures: Mapping[str, float], step: float) -> float | None:
    """The time [s] that turns gains kd [N m s/rad] into the armatures [kg m^2]; None for a coincidence.

    It is no coincidence where gains differ and armatures with them, or where the time is the step of the samples.
    Source: MuJoCo's integrators, (M + h kd) a = f for a damping of kd and a step of h.
    """
    gains = np.array([gain for name, gain in kd.items() if gain > 0.0 and name in armatures])
    if not len(gains):
        return None
    times = np.array([armatures[name] / gain for name, gain in kd.items() if gain > 0.0 and name in armatures])
    common = float(np.median(times))
    alike = common > 0.0 and bool((np.abs(times / common - 1.0) < _ALIKE).all())
    known = gains.max() > _DIFFERENT * gains.min() or abs(common / step - 1.0) < _SAME_STEP
    return common if alike and known else None


def _unlike_joints(run: Results) -> Iterator[str]:
    """That the fit leaves much of the torque of single joints of a robot with a fixed base."""
    fitted = run.metrics["train"].identified
    if run.experiment.robot.fixed_base and (joints := unexplained_joints(fitted)):
        shares = fitted.by_joint_relative
        named = join_names([f"{format_percent(shares[name] or 0.0)} % of the torque of {name}" for name in joints])
        yield f"The model does not explain {named}. Check sign, unit, gear and encoder there: torchid check."


def _far_off(fitted: FittedPosterior) -> Iterator[str]:
    """That bodies are further off their file than the prior of `torchid sample` assumes."""
    nominal = fitted.nominal_error
    if nominal is not None and nominal.prior_is_narrow:
        causes = ["the model does not explain these forces", "the file is of another robot"]
        if thin := [
            name for name, is_thin in zip(fitted.body_names, fitted.posterior.thin_bodies(), strict=True) if is_thin
        ]:
            causes.append(f"it has rods or plates ({join_names(thin)})")
        why = f": {', '.join(causes[:-1])}, or {causes[-1]}" if nominal.value > _ANOTHER_ROBOT else ""
        yield f"{nominal}{why}. Other bodies may be as far off: use torchid sample --prior-error auto."
