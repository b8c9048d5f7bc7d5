"""Measured forces against the URDF: refusals of a fit, and the mistake that explains the forces best."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid import parameters
from torchid.errors import InputError, format_percent, join_names
from torchid.log_checks.equations import (
    DECLARED_SCALE,
    MAX_LEFT,
    MIN_BLOCK_SHARE,
    MIN_UNEXPLAINED_RATIO,
    SCALED_TORQUE_STD,
    UNMODELLED_FORCE_SHARE,
    Declared,
    Explanation,
    FilteredLog,
    ForceEquations,
    NominalModel,
    bind_some_samples,
    default_cutoff_hz,
    equations_of,
    preprocess_pieces,
    reach,
    reading_noise,
)
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, UNEXPLAINED, Finding, Skipped, median_step, refused
from torchid.log_checks.mistakes import Mistake, joint_mistakes, possible_mistakes
from torchid.log_checks.motion import DEAD_ENCODER_ADVICE, still_joints
from torchid.log_checks.unknowns import (
    MIN_UNEXPLAINED,
    READINGS,
    best_explanation,
)
from torchid.logs import Log
from torchid.logs.segments import with_delayed_torques
from torchid.parallel import one_thread
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import subsample_states
from torchid.problem.contact_state import state_name
from torchid.problem.samples import require_forces
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values
from torchid.settings import AUTO

#: What the best URDF near the given one leaves of the forces, in `UNMODELLED_FORCE_SHARE` of these, from which on they
#: contradict the URDF. Of simulated logs clean ones leave 0.4 at most, those with a mistake without a row 4.8 or more.
MIN_CONTRADICTION = 2.0
#: What a factor of time may leave of them.
_MAX_LEFT_BY_TIME = 1.0
#: Share of what is unexplained that the correction of a usual mistake may leave.
MAX_CORRECTED_SHARE = 0.5
#: Corrections that explain as much as the best one, up to this ratio, are named beside it.
_ALIKE_RATIO = 1.1
#: Evenly spread samples of each corrected log.
TRIAL_SAMPLES = 120
#: Samples of each contact state whose rank is counted, and states that a finding names.
_RANK_SAMPLES = 60
_NAMED = 3
#: Factor of time that no error of inertias explains: its square is 2.25.
MIN_TIME_FACTOR = 1.5
#: Factors of time that are tried, and that at which accelerations vanish.
_TIME_FACTORS = np.geomspace(1e-4, 1e4, 1601)
_REST_FACTOR = 1e4
#: Unexplained forces with the recorded time, or at rest, over those with the corrected time; the same where that leaves
#: more than `_MAX_LEFT_BY_TIME`: an arm with a tool of 2.5 kg that its URDF does not have is explained half as badly by
#: 0.66 times the time.
_MIN_TIME_RATIO = 1.5
_MIN_TIME_RATIO_OF_ANOTHER_ROBOT = 10.0
_TIME_UNITS = {60.0: "minutes", 1e-3: "ms", 1e3: "ks", 3600.0: "hours"}
#: Share of the power of positions within the bandwidth of the motion, the cutoff over that bandwidth, its minimum in
#: periods per log (the filter spoils two at each end), and its maximum over the sample rate.
_MOTION_POWER_SHARE = 0.99
_CUTOFF_BANDWIDTHS = 6.0
_MIN_CUTOFF_PERIODS = 20.0
_MAX_CUTOFF_RATE_SHARE = 0.2
#: What dry friction may carry of the largest load where a joint stands still.
MAX_FRICTION_SHARE = 0.2
#: Share of what is unexplained that the torque of a joint that stands still must make up.
_MIN_DEAD_SHARE = 0.36
#: Friction of a joint over all else in its torque, from which on it tells the sign of the torque.
_MIN_FRICTION_RATIO = 2.0
#: Largest moment of inertia over the sum of all three: plates have 0.5, and files round.
_MAX_MOMENT_SHARE = 0.51
#: Density of a ball of the same mass and radius of gyration [kg/m^3]: less than of air, more than of lead or tungsten.
_MIN_DENSITY = 1.0
_MAX_DENSITY = 20_000.0
#: Volume of a ball over the third power of its radius of gyration.
_BALL_VOLUME = 4.0 / 3.0 * np.pi * (5.0 / 3.0) ** 1.5
#: Share of the robot's mass below which bodies are not looked at, and number of bodies that may be alike.
_MIN_MASS_SHARE = 1e-4
_MIN_BODIES = 4
_TINY = 1e-9
#: Range of the moments of inertia of a body, over the largest, that counts as rounding.
_EQUAL_MOMENTS = 1e-6
_FORCE_CHECK = "forces against the model"


def check_required(
    samples: Samples, robot: Robot, contacts: Sequence[Contact], required: SensorSet, goes_on: bool
) -> Iterator[Finding]:
    """Findings about a log that a fit would refuse.

    Args:
        samples: some of the log.
        robot: the robot.
        contacts: of it.
        required: sensors of the fit.
        goes_on: whether the fit continues where the base is lost.
    """
    try:
        require_forces(samples, robot, contacts, required)
    except InputError as error:
        yield refused(error)
    if not robot.fixed_base and not goes_on:
        yield from _lost_base(samples, RowBuilder(robot, contacts, required))


@one_thread()
@torch.no_grad()
def _lost_base(samples: Samples, builder: RowBuilder) -> Iterator[Finding]:
    """A finding about contact states in which rank(S_b V_x) is below 6 in most samples."""
    ranks = defaultdict[str, list[torch.Tensor]](list)
    counts = Counter[str]()
    for part, state, weight in subsample_states([samples], _RANK_SAMPLES):
        name = state_name(builder.contacts, state)
        counts[name] += round(weight * len(part))
        for _, V in builder.null_space_bases(state, builder.kinematics(part)):
            ranks[name].append(base_rank(base_singular_values(V)))
    usual = {name: int(torch.cat(ranks[name]).median()) for name, _ in counts.most_common()}
    if lost := {name: rank for name, rank in usual.items() if rank < 6}:
        named = "; ".join(f"{name}: rank {rank} of 6" for name, rank in list(lost.items())[:_NAMED])
        more = f"; and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        text = f"the base is lost, rank(S_b V_x) < 6, in these contact states: {named}{more}"
        advice = "add sensors (torchid analyze finds a set), exclude these samples, or set sensors.on_base_lost: warn"
        yield Finding("does not fit", REJECTED, "sensors", text, advice)


def check_forces_against_urdf(
    log: Log,
    robot: Robot | None,
    contacts: Sequence[Contact],
    cutoff_hz: float | None,
    derived: tuple[str, ...] = (),
    declared: Declared | None = None,
    required: SensorSet | None = None,
) -> Iterator[Finding | Skipped]:
    """Findings about joint torques and contact wrenches.

    Args:
        log: the log.
        robot: the robot.
        contacts: of it.
        cutoff_hz: of the fit, None for a usual one.
        derived: prefixes of fields that torchid computed.
        declared: what is known of the sensors.
        required: sensors of a fit, which must be in the log.
    """
    if robot is None:
        yield Skipped(_FORCE_CHECK, "no robot (--urdf)")
        return
    noise = 0.0 if log.joint_torque is None else reading_noise(log, robot)
    model = NominalModel(robot, contacts, declared or Declared(), noise)
    log = with_delayed_torques(log, model.declared.known_delay)
    filtered = FilteredLog(log, model, cutoff_hz or default_cutoff_hz(log))
    try:
        filtered.pieces  # noqa: B018 (too short, or sampled too slowly by its time stamps)
    except InputError as error:
        skipped = Skipped(_FORCE_CHECK, f"{error.field}: {error.found}") if required is None else refused(error)
        scale = _time_scale(log, model)
        yield skipped if scale is None else scale.findings[0]
        return
    try:
        samples = bind_some_samples(filtered.pieces, robot, contacts)
    except InputError as error:
        yield refused(error)
        return
    if required is not None:
        yield from check_required(samples, robot, contacts, required, model.declared.goes_on_without_base)
    filtered = _with_declared_scales(filtered)
    if filtered.equations is None:
        yield Skipped(_FORCE_CHECK, "the log has neither joint torques nor contact wrenches")
    else:
        yield from _mistakes(filtered, filtered.equations, derived)


def _has_scaled_torques(model: NominalModel) -> bool:
    """Whether an arm's torques with declared unknown scales are scaled to the size that its URDF requires."""
    return "joint_torque" in model.declared.terms.scales and model.is_bolted_arm


def _with_declared_scales(filtered: FilteredLog) -> FilteredLog:
    """The log of a fixed-base arm; torques with a declared unknown scale are scaled to the size that the URDF requires.

    Equations are weighted by the size of the readings.
    """
    model = filtered.model
    if not _has_scaled_torques(model) or filtered.equations is None:
        return filtered
    factor = filtered.equations.declared_torque_scales()
    columns = [factor[model.robot.joint_names.index(name)] for name in filtered.log.joint_names]
    log = replace(filtered.log, joint_torque=np.asarray(filtered.log.joint_torque) * columns)
    model = replace(model, reading_noise=factor * model.reading_noise, scale_std=SCALED_TORQUE_STD)
    return FilteredLog(log, model, filtered.cutoff_hz)


def _mistakes(filtered: FilteredLog, equations: ForceEquations, derived: tuple[str, ...]) -> Iterator[Finding]:
    """Findings about the mistake of the file or the log that explains the forces best, or about a contradiction."""
    if backward := list(_driving_friction(filtered, equations)):
        yield from backward
        return
    filtered = _with_found_delay(filtered, derived)
    equations = filtered.equations or equations
    given = equations.unexplained
    robot = filtered.model.robot
    implausible = list(implausible_bodies(robot))
    if implausible:
        filtered = _without(implausible, filtered)
        equations = filtered.equations or equations
    is_contradicted = given > max(MIN_UNEXPLAINED, MIN_UNEXPLAINED_RATIO * equations.unexplained)
    findings = list(_mistakes_of_log(filtered, equations, derived))
    if not findings and equations.unexplained > MIN_CONTRADICTION:
        is_contradicted = True
        if not implausible:
            yield _contradiction(given, filtered.model)
    if implausible:
        yield _inertials_finding(implausible, robot, SUSPICIOUS if is_contradicted else NOTE)
    yield from findings


def _with_found_delay(filtered: FilteredLog, derived: tuple[str, ...]) -> FilteredLog:
    """The log without the delay of its torques, if the fit estimates it and it explains the forces best."""
    best = best_explanation(filtered, derived) if filtered.model.declared.delay == AUTO else None
    if best is None or (best.findings[0].name, best.findings[0].field) != ("delay", "joint_torque"):
        return filtered
    return replace(filtered, log=with_delayed_torques(filtered.log, -float(best.value[0])))


def _mistakes_of_log(filtered: FilteredLog, equations: ForceEquations, derived: tuple[str, ...]) -> Iterator[Finding]:
    """The mistake of the log that explains the forces best."""
    best = best_explanation(filtered, derived)
    least = equations.unexplained if best is None else best.left
    if least > MIN_UNEXPLAINED:
        usual = _usual_mistake(filtered, equations, derived), _time_scale(filtered.log, filtered.model)
        better = [trial for trial in usual if trial is not None and trial.left * MIN_UNEXPLAINED_RATIO < least]
        best = min(better, key=lambda trial: trial.left, default=best)
    yield from _dead_encoders(filtered, equations) if best is None else best.findings


@dataclass(frozen=True)
class ImplausibleBody:
    """A body with an implausible mass or inertia.

    Attributes:
        number: of the body.
        fault: what is wrong.
        of_mass: whether the mass may be wrong; else only the inertia.
    """

    number: int
    fault: str
    of_mass: bool = True


def implausible_bodies(robot: Robot) -> Iterator[ImplausibleBody]:
    """Implausible masses and inertias in the robot's file."""
    mass = robot.nominal[:, parameters.MASS]
    total = float(np.abs(mass).sum())
    length = reach(robot)
    bodies = [number for number, body in enumerate(robot.bodies) if not body.massless]
    moments = {number: np.linalg.eigvalsh(parameters.mass_com_inertia(robot.nominal[number])[2]) for number in bodies}
    isotropic = Counter(f"{x[0]:.4g}" for x in moments.values() if np.ptp(x) < _EQUAL_MOMENTS * x[-1])
    for number, (least, _, largest) in moments.items():
        trace = float(moments[number].sum())
        if mass[number] <= 0.0:
            yield ImplausibleBody(number, f"a mass of {mass[number]:.3g} kg")
        elif mass[number] < _MIN_MASS_SHARE * total:
            continue
        elif largest > _MAX_MOMENT_SHARE * trace or least < 0.0:
            fault = "one moment of inertia larger than the sum of the two others, or negative"
            yield ImplausibleBody(number, fault, of_mass=False)
        elif (radius := np.sqrt(0.5 * trace / mass[number])) > length > 0.0:
            yield ImplausibleBody(number, f"a radius of gyration of {radius:.2g} m in a robot of {length:.2g} m")
        elif not _MIN_DENSITY < (density := mass[number] / (_BALL_VOLUME * max(radius, _TINY) ** 3)) < _MAX_DENSITY:
            yield ImplausibleBody(number, f"a density of {density:.2g} kg/m^3 as a ball")
        elif 2 * isotropic[f"{least:.4g}"] > max(len(bodies), _MIN_BODIES):
            fault = f"moments of inertia of {least:.3g} kg m^2 about all axes, like most bodies"
            yield ImplausibleBody(number, fault, of_mass=False)


def _inertials_finding(bodies: Sequence[ImplausibleBody], robot: Robot, severity: str) -> Finding:
    """A finding about the robot's file alone; not a note if forces contradict the file."""
    names = [robot.bodies[body.number].name for body in bodies]
    named = join_names([f"{name} has {body.fault}" for name, body in zip(names, bodies, strict=True)], _NAMED)
    contradicted = "" if severity == NOTE else ", and forces contradict it"
    advice = f"correct masses and inertias of these links in the {robot.format}; look for a lost decimal point"
    text = f"the {robot.format} is implausible{contradicted}: {named}"
    return Finding("inertials", severity, "robot", text, advice, tuple(names))


def _without(bodies: Sequence[ImplausibleBody], filtered: FilteredLog) -> FilteredLog:
    """The log with a robot whose implausible bodies have unknown parameters."""
    unknown = np.zeros(filtered.model.robot.nominal.shape, bool)
    for body in bodies:
        unknown[body.number, parameters.INERTIAL if body.of_mass else parameters.INERTIA] = True
    return replace(filtered, model=replace(filtered.model, unknown=unknown))


def _contradiction(unexplained: float, model: NominalModel) -> Finding:
    """A finding about forces that no usual mistake explains."""
    form = model.robot.format
    share = format_percent(UNMODELLED_FORCE_SHARE * unexplained)
    text = f"{share} % of the forces are unexplained, even with small changes of the {form}'s parameters"
    advice = (
        f"check units, frames, friction, the order of joints and contacts, the {form}'s base link and masses, and that"
        f" the {form} describes this robot"
    )
    if not model.contacts and not model.robot.fixed_base:
        advice = f"list under contacts what touches the ground or holds the base; or {advice}"
    return Finding("forces", SUSPICIOUS, "all", text + UNEXPLAINED, advice)


def _usual_mistake(filtered: FilteredLog, equations: ForceEquations, derived: tuple[str, ...]) -> Explanation | None:
    """The usual mistake of the motion whose correction explains the forces much better."""
    log = filtered.log
    model = filtered.model
    unexplained = equations.unexplained
    of_joints: Iterable[Mistake] = joint_mistakes(log) if model.is_bolted_arm else ()
    trials = list[tuple[float, Mistake]]()
    for mistake in (*possible_mistakes(log, model.robot), *of_joints):
        if mistake.field.startswith(derived or ("-",)) or mistake.field in READINGS:
            continue
        try:
            corrected = _corrected(mistake, filtered, equations)
        except InputError:  # the filter does not accept it then
            continue
        if corrected is not None:
            trials.append((corrected.unexplained, mistake))
    trials.sort(key=lambda trial: trial[0])
    if not trials or trials[0][0] > min(MAX_LEFT, MAX_CORRECTED_SHARE * unexplained):
        return None
    left, best = trials[0]
    ratio = unexplained / max(left, 1e-9)
    text = f"{best.description}: correcting this makes unexplained forces {ratio:.2g} times smaller"
    for other_left, other in trials[1:]:
        if other_left < _ALIKE_RATIO * left and other.description != best.description:
            text += f". As likely: {other.field} {other.description}"
    finding = Finding("unit, sign or frame", REJECTED, best.field, text, best.advice)
    return Explanation([finding], left, 1, np.zeros(0))


def _corrected(mistake: Mistake, filtered: FilteredLog, equations: ForceEquations) -> ForceEquations | None:
    """Equations of some samples of the corrected log."""
    if _has_scaled_torques(filtered.model):
        corrected = FilteredLog(mistake.correct(filtered.log), filtered.model, filtered.cutoff_hz)
        return _with_declared_scales(corrected).equations
    if mistake.after_filter:
        pieces = [mistake.correct(piece) for piece in filtered.pieces]
    else:
        pieces = preprocess_pieces(mistake.correct(filtered.log), filtered.cutoff_hz)
    return equations_of(pieces, filtered.model, TRIAL_SAMPLES, equations.builder)


def _driving_friction(filtered: FilteredLog, equations: ForceEquations) -> Iterator[Finding]:
    """Findings about joints of a fixed-base arm with a torque that is mostly friction of the wrong sign."""
    robot = filtered.model.robot
    samples = equations.samples
    readings = equations.samples.torque
    if not filtered.model.is_bolted_arm or readings is None:
        return
    for joint, name in enumerate(robot.joint_names):
        torque = readings[:, joint].numpy()
        velocity = samples.joint_velocity[:, joint].numpy()
        if not equations.builder.sensors.torque[joint] or not velocity.any():
            continue
        terms = np.stack([np.sign(velocity), velocity, equations.required[:, joint], np.ones_like(torque)], axis=1)
        size = np.maximum(np.linalg.norm(terms, axis=0), 1e-12)
        parts = terms / size * np.linalg.lstsq(terms / size, torque, rcond=None)[0]
        friction = parts[:, :2].sum(axis=1)
        load = parts[:, 2:].sum(axis=1)
        others = np.linalg.norm(load) + np.linalg.norm(torque - friction - load)
        if friction @ velocity < 0.0 and np.linalg.norm(friction) > _MIN_FRICTION_RATIO * others:
            text = f"{name}: the torque is reversed. It is mostly friction, which would drive the joint"
            advice = "reverse these torques; or positions and velocities, if these are reversed"
            yield Finding("sign", REJECTED, "joint_torque", text, advice, (name,))


def _dead_encoders(filtered: FilteredLog, equations: ForceEquations) -> Iterator[Finding]:
    """Findings about joints at rest with an unexplained torque; notes if friction may hold them."""
    robot = filtered.model.robot
    readings = equations.samples.torque
    still = still_joints(filtered.log)
    if not still or readings is None or equations.unexplained < MIN_UNEXPLAINED:
        return
    residuals = equations.residuals()
    rows = equations.W[:, equations.builder.tree.base_rows :][:, : robot.n]
    along = np.einsum("njr,nr->nj", rows, residuals)
    size = np.square(rows).sum(axis=2)
    made_up = np.square(along) / np.where(size > 0.0, size, np.inf)
    error = np.sqrt(np.square(along / np.where(size > 0.0, size, np.inf)).mean(axis=0))
    share = made_up.sum(axis=0) / np.square(residuals).sum()
    load = np.sqrt(np.square(np.nan_to_num(readings[:, : robot.n].numpy())).mean(axis=0))
    for name in still:
        joint = robot.joint_names.index(name) if name in robot.joint_names else -1
        if joint < 0 or share[joint] < _MIN_DEAD_SHARE:
            continue
        unit = "N" if name in robot.sliding else "N m"
        text = f"{name} stands still with an unexplained load of {error[joint]:.2g} {unit} (rms)"
        held = error[joint] < MAX_FRICTION_SHARE * float(load.max())
        advice = "nothing if friction or a brake holds it; else " * bool(held) + DEAD_ENCODER_ADVICE
        yield Finding("dead encoder", NOTE if held else SUSPICIOUS, "joint_position", text, advice, (name,))


# -------------------------------------------------------------------------------------------------------- unit of time


def motion_cutoff_hz(log: Log) -> float | None:
    """A cutoff [Hz] from the spectrum of the joint positions, for any unit of time; None where no joint moves."""
    position = log.joint_position[: 2 * (len(log) // 2)]
    window = np.hanning(len(position))[:, None]  # a log that ends elsewhere than it began has no jump between
    power = np.square(np.abs(np.fft.rfft(window * (position - position.mean(axis=0)), axis=0))).sum(axis=1)
    power[0] = 0.0
    if not power.sum() > 0.0:
        return None
    last = int(np.searchsorted(np.cumsum(power), _MOTION_POWER_SHARE * power.sum()))
    step = median_step(log)
    lowest = max(_CUTOFF_BANDWIDTHS * last, _MIN_CUTOFF_PERIODS) / (step * len(position))
    return float(min(lowest, _MAX_CUTOFF_RATE_SHARE / step))


def _time_scale(log: Log, model: NominalModel) -> Explanation | None:
    """Time in another unit: gravity and inertia explain the forces in that unit only.

    Velocities and accelerations scale with the inverse of time and its square, gravity is constant: three factors
    determine the forces at all others. Noise of positions makes accelerations without forces, as stamps that are too
    dense do: the corrected time must also explain the forces better than a robot at rest.
    """
    cutoff_hz = motion_cutoff_hz(log)
    model = replace(model, scale_std=DECLARED_SCALE)
    if cutoff_hz is None:
        return None

    def samples_at(factor: float) -> Samples:
        scaled = replace(log, time=log.time[0] + factor * (log.time - log.time[0]))
        return bind_some_samples(preprocess_pieces(scaled, cutoff_hz / factor), model.robot, model.contacts)

    try:
        recorded = samples_at(1.0)
        doubled = samples_at(2.0)
        at_rest = samples_at(_REST_FACTOR)
        equations = ForceEquations.of(at_rest, model)
    except InputError:
        return None
    if equations is None:
        return None
    gravity = equations.required
    total = equations.required_of(recorded)
    slower = equations.required_of(doubled)
    quadratic = 2.0 * (total - gravity) - 4.0 * (slower - gravity)
    products = equations.reduced(np.stack([total - gravity - quadratic, quadratic], axis=2)).products
    u = np.stack([np.ones_like(_TIME_FACTORS), 1.0 / _TIME_FACTORS, 1.0 / _TIME_FACTORS**2])
    cost = np.einsum("ks,bkl,ls->bs", u, products, u)
    best = int(np.argmin(cost[0]))
    unity = int(np.argmin(np.abs(np.log(_TIME_FACTORS))))
    unexplained = np.sqrt(np.maximum(cost[0], 0.0) / max(equations.rows, 1))
    factor = float(_TIME_FACTORS[best])
    blocks = _TIME_FACTORS[np.argmin(cost[1:], axis=1)]
    agree = np.log(blocks) * np.sign(np.log(factor)) > MIN_BLOCK_SHARE * abs(np.log(factor))
    ratio = min(unexplained[unity], unexplained[-1]) / max(unexplained[best], 1e-9)
    makes_up = (
        unexplained[best] <= _MAX_LEFT_BY_TIME
        or unexplained[unity] >= _MIN_TIME_RATIO_OF_ANOTHER_ROBOT * unexplained[best]
    )
    if abs(np.log(factor)) < np.log(MIN_TIME_FACTOR) or not agree.all() or ratio < _MIN_TIME_RATIO or not makes_up:
        return None
    units = [name for size, name in _TIME_UNITS.items() if abs(factor / size - 1.0) < 0.1]
    text = f"gravity and inertia explain the measured forces if time is multiplied by {factor:.3g}"
    advice = "convert time to seconds; check the sample rate of the stamps"
    finding = Finding("unit", REJECTED, "time", f"in {units[0]}: {text}" if units else text, advice)
    return Explanation([finding], float(unexplained[best]), 1, np.array([factor]))
