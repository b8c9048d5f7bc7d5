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
from torchid.fitting.fit import Confounded, list_confounded
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
_IN_PART = " in part"
#: By the least and the largest error of a group of rows, as shares of the URDF's.
_VERDICTS = {
    (0.5, 0.5): "Much better",
    (0.95, 0.95): "Better",
    (0.95, np.inf): f"Better{_IN_PART}",
}
_NO_BETTER = "No better"


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

    def headline(self, unexplained: str = "") -> str:
        """The verdict in a sentence; `unexplained`: forces of the fit that the model does not explain, in words."""
        ratios = [after / before if before else 1.0 for _, before, after, _ in self.errors()]
        if not ratios:
            return f"Nothing to compare with the {self.of} on {self.text}"
        least = min(ratios)
        most = max(ratios)
        shares = f"{format_percent(least)} to " * (most > 1.1 * least) + f"{format_percent(most)} %"
        within = (text for limits, text in _VERDICTS.items() if least < limits[0] and most < limits[1])
        verdict = next(within, _NO_BETTER)
        known = [after / floor for _, _, after, floor in self.errors() if floor]
        floor = ", as near as the sensors' noise allows" if known and max(known) < AT_THE_FLOOR else ""
        if unexplained:
            return f"The model does not explain {unexplained}: errors of {shares} of the {self.of}'s on {self.text}"
        better, parts, worse = compare_parts(self.nominal, self.identified)
        if self.at_rest:
            judged = f"errors of {shares} of the {self.of}'s{floor}; inertia and friction are not judged"
            return f"At rest alone, as nothing moves in {self.text}: {judged}"
        if worse:
            where = f"better in {better} of {parts} joints and base axes, worse in {join_names(worse, 1)}"
            return f"Mixed, against the {self.of} on {self.text}: {where}"
        words = verdict.removesuffix(_IN_PART)
        part = _IN_PART * verdict.endswith(_IN_PART)
        return f"{words} than the {self.of}{part} on {self.text}: errors of {shares} of the {self.of}'s{floor}"

    def shown_errors(self) -> list[tuple[str, float, float, float | None]]:
        """Errors that a user should see, by the words for their group, with units."""
        few = len(list(self.errors())) < _FEW_GROUPS  # no joint of its own, as all legs stand: their projection
        errors = self.errors((*(ERROR_GROUPS if few else DECISIVE_GROUPS), PRESSURE))
        return [(self.identified.label(group), before, after, floor) for group, before, after, floor in errors]


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
        headline: how much better than the URDF it predicts, and what.
        errors: groups of rows with the rms errors of the URDF's and of the identified parameters, and what noise of the
            readings leaves, None where it is not known.
        total_mass: with its standard error, beside the URDF's.
        bodies: whether all can exist.
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
    return Answer(
        headline=_headline(run, judged),
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
        said.append(("total mass", f"{run.mass} ({robot.format}: {decimal(run.mass.nominal)} kg)"))
    sets = {name: (pair.identified, pair.nominal) for name, pair in run.metrics.items()}
    if run.validation is not None:
        sets["left out"] = (run.validation.identified, run.validation.nominal)
    for name, (identified, nominal) in sets.items():
        texts = (describe_errors(group, identified.rms_of(group), nominal.rms_of(group)) for group in DECISIVE_GROUPS)
        said.append((name, "; ".join(filter(None, texts))))
    trouble = [
        *([f"WORSE THAN {robot.format}: {describe_worse(run.worse, robot.format)}"] if run.worse else []),
        str(run.misfit),
    ]
    said += [("attention", "; ".join(filter(None, trouble)))] if any(trouble) else []
    said.append(("written to", str(config.output or "no folder: write(folder), to_urdf(file)")))
    title = f"{robot.path.name}, {len(run)} bodies, {format_count(robot.n, 'joint')}, by {config.estimator.name}"
    lines = (f"{label:12}{shorten(text, _WIDTH, placeholder=' ...')}" for label, text in said)
    return [f"Identification of {title}", *lines]


def _total_mass(run: Results) -> str:
    gain = run.experiment.config.sensors.gain_error
    file_kind = run.experiment.robot.format
    counted = run.mass.determined and run.estimate.gain_error is not None and run.estimate.gain_error.any()
    gains = f"; ± counts gain errors of {100.0 * gain:g} %" if counted else ""
    return f"{run.mass} ({file_kind}: {decimal(run.mass.nominal)} kg{gains})"


def _judge(run: Results) -> ErrorComparison:
    file_kind = run.experiment.robot.format
    if "test" in run.metrics:
        files = run.experiment.config.logs
        names = [log_title(path) for path in files.test]
        motion = "motion that the fit has seen" if tests_on_seen_samples(files) else "unseen motion"
        at_rest = "test" in run.at_rest
        text = f"{'the test logs' if at_rest else motion} ({join_names(names, 2)})"
        return ErrorComparison(text, run.metrics["test"].nominal, run.metrics["test"].identified, file_kind, at_rest)
    if run.validation is not None:
        text = f"blocks of the training logs, each left out of the fit ({run.validation.folds})"
        return ErrorComparison(
            text, run.validation.nominal, run.validation.identified, file_kind, "train" in run.at_rest
        )
    nominal, identified = run.metrics["train"]
    return ErrorComparison("the training logs themselves", nominal, identified, file_kind, "train" in run.at_rest)


def _headline(run: Results, judged: ErrorComparison) -> str:
    if run.worse:
        return f"WORSE THAN {judged.of}: {describe_worse(run.worse, judged.of)}"
    explained = not any((*_unlike_sensors(judged.identified), *_unlike_joints(run)))
    return judged.headline("" if explained else "these forces")


def _bodies_text(run: Results) -> str:
    names = []
    robot = run.experiment.robot
    for violation in run.violations:
        if violation.body is not None and robot.body_names[violation.body] not in names:
            names.append(robot.body_names[violation.body])
    count = len(robot.body_names)
    if all(violation.term is not None for violation in run.violations):
        ends = massless_ends(robot, run.phi)
        if ends:
            return f"all that have mass can exist; MuJoCo refuses joints that move none: {join_names(ends)}"
        if run.refused:
            return f"all {count} can exist, but simulators refuse their file: {run.refused}"
        return f"all {count} can exist, and simulators take them"
    which = f"{len(names)} of {count}" if names else "all together"
    advice = "; estimator.name=consistent finds the best that can" if type(run.estimate) is Estimate else ""
    return f"{which} cannot exist, and simulators refuse them{advice}"


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
    let = f", and the fit lets it be {decimal(mass.value)} kg ({decimal(mass.nominal)} kg by the {file_kind})" * is_off
    independent = f"{run.samples / estimate.oversampling:.0f} independent samples"
    rules = (
        (bool(run.worse), ADVICE),
        (bool(run.suspected), f"torchid check finds in {run.suspected}"),
        *((True, text) for text in _unfinished(estimate)),
        *((True, text) for text in _unlike_sensors(judged.identified)),
        *((True, text) for text in _computed(judged)),
        (bool(terms), f"negative, which nothing is: {join_names(terms)}; estimator.name=consistent finds the best "
                      "that can be"),
        (growth > _MUCH_MORE and (run.misfit.share or 0.0) > _EXACT_SHARE,
         f"no bodies that can exist explain these forces: they leave {growth:.2g} times as much as bodies that cannot; "
         "unit, gear or sign of a torque? (torchid check)"),
        *((True, text) for text in _driving(run)),
        *((True, text) for text in _unlike_joints(run)),
        *((True, text) for text in _heavy(run)),
        (not run.misfit.explained,
         "friction, compliance or contacts are missing, or a sensor is wrong (torchid check): "
         f"{run.misfit.in_short}"),
        *((True, text) for text in _resting(run)),
        (contradicts, f"the total mass is {ratio:.3g} times the {file_kind}'s: weigh the robot, or mend units and "
                      "gains of forces: torchid check"),
        (not run.misfit.judged,
         "whether the model explains these forces is not known: no noise is stated, and the logs are too short to tell "
         "it from errors of the model; state sensors.noise, or record more"),
        (estimate.block_error is None,
         f"95 % intervals count noise alone, no error of the model, which {independent} do not show: record more"),
        (is_open, f"these data do not determine the total mass{let}; weigh the robot: estimator.total_mass"),
        *((True, text) for text in _implicit(run)),
        *((True, confounded.in_short) for confounded in _confounded(run)),
        *((True, text) for text in _far_off(run.posterior)),
        (bool(run.noise.suggested), f"noise: {noise_advice(run.noise.suggested)}"),
    )  # fmt: skip
    return (text for applies, text in rules if applies)


def _confounded(run: Results) -> Sequence[Confounded]:
    return list_confounded([x for x in run.extras if x.extra.what not in run.choices.adopted_terms])


def _unfinished(estimate: Estimate) -> Iterator[str]:
    """How far above the least objective under the same conditions a descent ended."""
    if isinstance(estimate, SgdEstimate) and not estimate.converged:
        share = "an unknown" if estimate.excess is None else f"{100.0 * estimate.excess:.2g}"
        advice = "more estimator.training.epochs, or estimator.name=consistent"
        yield f"not converged: {share} % above the optimum; {advice}"


def _resting(run: Results) -> Iterator[str]:
    """That joints rest where forces are not explained, or all the time where their torques count as unmeasured then."""
    if run.experiment.config.actuators.stiction:
        if still := [name for name, share in run.resting.items() if share == 1.0]:
            names = join_names(still, _FEW_NAMED)
            why = "no torque counts as measured then (actuators.stiction)"
            yield f"no friction of {names}: at rest, or too near to it for the filter, throughout; {why}"
    elif run.resting and not run.misfit.explained:
        names = join_names([f"{name} {100.0 * share:.0f} %" for name, share in run.resting.items()], _FEW_NAMED)
        why = "where one sticks, its friction is less than Coulomb's, and too little is found"
        yield f"actuators.stiction=true, as joints rest ({names}): {why}"


def _unlike_sensors(identified: Metrics) -> Iterator[str]:
    """Readings that the identified parameters explain worse than no bodies, or a constant base force, would."""
    for group in (*LIMB_GROUPS, "nullspace"):
        share = identified.relative_of(group)
        if share is not None and share > _LARGER_THAN_MEASURED:
            in_limb = group in LIMB_GROUPS
            name = group_name(group) if in_limb else "forces without those of the contacts"
            whose = "the sensor's sign, unit and frame" if in_limb else "signs, units and order of joints"
            yield f"{name}: errors of {share:.2g} times what was measured; check {whose}: torchid check"
    share = identified.base_force_of_variation
    of_weight = identified.relative_of("base_force")
    if share is not None and share > _LARGER_THAN_MEASURED and (of_weight or 0.0) > MAX_MASS_ERROR:
        ratio = f"base force: errors of {share:.2g} times what its measurements vary by"
        yield f"{ratio}; check frames, signs and units of contact forces and of the base's pose: torchid check"


def _computed(judged: ErrorComparison) -> Iterator[str]:
    """That the robot's file itself predicts the forces better than any file predicts those of a real robot."""
    shares = [share for group in ERROR_GROUPS if (share := judged.nominal.relative_of(group)) is not None]
    if shares and max(shares) < _COMPUTED:
        to = f"to {format_percent(max(shares))} %"
        yield f"the {judged.of} predicts these forces {to}: were they computed from it, or commanded, not measured?"


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
        why = f"which the data do not determine: an estimator.ridge above {run.experiment.config.estimator.ridge}"
        yield f"{join_names(named, _FEW_NAMED)} the {robot.format}'s mass, {why}"


def _driving(run: Results) -> Iterator[str]:
    """That Coulomb friction is negative far beyond its standard errors, which least squares lets it be."""
    value, error = (x.reshape(-1, PER_BODY)[:, COULOMB] for x in (run.estimate.phi, run.estimate.standard_error))
    bodies = np.array(run.experiment.robot.bodies, object)[value < -_CLEAR_ERRORS * error]
    if len(bodies) and (run.misfit.share or 0.0) > _EXACT_SHARE:
        names = join_names([body.joint.name for body in bodies], _FEW_NAMED)
        yield f"friction drives {names}: its torque is reversed, or its friction of another shape: torchid check"


def _implicit(run: Results) -> Iterator[str]:
    """That armatures are those which a simulator's implicit integration of a PD law adds, where its kd is stated."""
    logs = run.experiment.config.logs
    robot = run.experiment.robot
    torque = logs.columns.joint_torque if logs.columns else None
    if run.forces is None or torque is None or torque.pd is None or torque.pd.kd is None:
        return
    kd = values_by_name("logs.columns.joint_torque.pd.kd", torque.pd.kd.value, robot.joint_names)
    known = dict(zip(robot.joint_names, robot.armature.tolist(), strict=True))
    added = {x.extra.name: x.value - known[x.extra.name] for x in run.extras if x.extra.what == "armature"}
    if step := implicit_step(kd, added, 1.0 / run.forces.rate):
        yield f"armatures are {1e3 * step:.2g} ms times the stated kd: no rotors, but a simulator's implicit PD law"


def implicit_step(kd: Mapping[str, float], armatures: Mapping[str, float], step: float) -> float | None:
    """The time [s] by which armatures [kg m^2] are the gains kd [N m s/rad] times it; None for a coincidence.

    It is none where gains differ and armatures go with them, or where the time is the step of the samples.
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
    """That the fit leaves much of the torque of single joints of a bolted robot."""
    fitted = run.metrics["train"].identified
    if run.experiment.robot.fixed_base and (joints := unexplained_joints(fitted)):
        shares = fitted.by_joint_relative
        named = join_names([f"{format_percent(shares[name] or 0.0)} % of the torque of {name}" for name in joints])
        yield f"the fit leaves {named}; check sign, unit and gear there, and its encoder: torchid check"


def _far_off(fitted: FittedPosterior) -> Iterator[str]:
    """That bodies are further off their file than samples of what data leave open take them to be."""
    nominal = fitted.nominal_error
    if nominal is not None and nominal.prior_is_narrow:
        causes = ["the model does not explain these forces", "the file is another robot's"]
        if thin := [
            name for name, is_thin in zip(fitted.body_names, fitted.posterior.thin_bodies(), strict=True) if is_thin
        ]:
            causes.append(f"it has rods or plates ({join_names(thin)})")
        why = f": {', '.join(causes[:-1])}, or {causes[-1]}" if nominal.value > _ANOTHER_ROBOT else ""
        yield f"{nominal}{why}; other bodies may be as far off: torchid sample --prior-error auto"
