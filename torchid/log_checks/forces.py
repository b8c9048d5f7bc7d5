"""Measured forces against the URDF's: signs, units, scales, exchanged joints, and what explains a misfit."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from torchid.errors import InputError
from torchid.log_checks.encoders import check_encoders, is_bolted_arm, single_zero_findings
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, UNEXPLAINED, Finding, Skipped, refused
from torchid.log_checks.lags import check_lag_and_tilt, check_torque_offsets, without_lag
from torchid.log_checks.mistakes import Mistake, accelerometer_axes, joint_mistakes, possible_mistakes
from torchid.log_checks.model import (
    MAX_TRIAL_DIFFERENTIATED_SAMPLES,
    TRIAL_SAMPLES,
    UNMODELLED_FORCE_SHARE,
    Declared,
    ModelFit,
    NominalModel,
    TorqueFit,
    bind_some_samples,
    default_cutoff_hz,
    preprocess_pieces,
    torque_findings,
    without_friction,
)
from torchid.log_checks.scales import (
    MAX_LEFT,
    MIN_BLOCK_SHARE,
    MIN_UNEXPLAINED_RATIO,
    TIME_BLOCKS,
    DeviationRows,
    FilteredLog,
    NormalEquations,
    TimeScale,
    accumulate_blocks,
    common_factor_notes,
    common_gain_findings,
    fit_time_scale,
    fit_torque_gains,
    gain_and_point_findings,
    motion_cutoff_hz,
)
from torchid.logs import Log
from torchid.logs.log import WRENCHES, FloatArray
from torchid.logs.segments import with_delayed_torques
from torchid.logs.signal_noise import rough_noise
from torchid.parallel import one_thread
from torchid.parameters import COULOMB, VISCOUS
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import subsample_states
from torchid.problem.contact_state import state_name
from torchid.problem.samples import require_forces
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values
from torchid.settings import AUTO

#: Samples of each contact state whose rank is counted, and states that a finding names.
_SAMPLES, _NAMED = 60, 3


def check_required(
    samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact], required: SensorSet, goes_on: bool
) -> Iterator[Finding]:
    """Findings about a log that a fit would refuse.

    Args:
        samples: some of the log.
        robot: the robot.
        contacts: of it.
        required: sensors of the fit.
        goes_on: whether it goes on where the base is lost.
    """
    try:
        for part in samples:
            require_forces(part, robot, contacts, required)
    except InputError as error:
        yield refused(error)
    if not robot.fixed_base and not goes_on:
        yield from _lost_base(samples, RowBuilder(robot, contacts, required))


@one_thread()
@torch.no_grad()
def _lost_base(samples: Sequence[Samples], builder: RowBuilder) -> Iterator[Finding]:
    """A finding about contact states in which rank(S_b V_x) is below 6 in most samples."""
    ranks, counts = defaultdict[str, list[torch.Tensor]](list), Counter[str]()
    for part, state, weight in subsample_states(samples, _SAMPLES):
        name = state_name(builder.contacts, state)
        counts[name] += round(weight * len(part))
        for _, V in builder.null_space_bases(state, builder.kinematics(part)):
            ranks[name].append(base_rank(base_singular_values(V)))
    usual = {name: int(torch.cat(ranks[name]).median()) for name, _ in counts.most_common()}
    if lost := {name: rank for name, rank in usual.items() if rank < 6}:
        named = "; ".join(f"{name}: rank {rank} of 6" for name, rank in list(lost.items())[:_NAMED])
        more = f"; and {len(lost) - _NAMED} contact states more" if len(lost) > _NAMED else ""
        text = f"the base is lost, rank(S_b V_x) < 6, in contact with {named}{more}"
        advice = "measure more (torchid analyze finds what suffices), leave such samples out, or set"
        advice += " sensors.on_base_lost: warn"
        yield Finding("does not fit", REJECTED, "sensors", text, advice)


_TINY = 1e-9

#: Share of the exchange that corrected torques still ask for: a scale or an offset of one of the two asks for others.
_MAX_SHARE_LEFT = 0.25
#: Readings of a torque whose noise is looked at.
_MIN_READINGS = 20
#: Third singular value of two joints' motions over the first, of more than one rate.
_MIN_THIRD = 0.1


@dataclass(frozen=True, eq=False)
class _Exchanges:
    """What all pairs of joints (P, 2) explain if their torques are exchanged.

    Attributes:
        pairs: numbers of the joints.
        share: (P,) of the exchange that fits best: 1 where it is a mistake, 0 where it is none.
        without: unexplained forces without any exchange, rms in deviations of the torques.
        left: (P,) the same with it.
        equations: of what the nominal parameters leave, and of the pairs.
    """

    pairs: NDArray[np.intp]
    share: FloatArray
    without: float
    left: FloatArray
    equations: NormalEquations

    def gains(self, pair: int) -> FloatArray:
        """By how much less is unexplained with one exchange, squared, by block of time, (TIME_BLOCKS,)."""
        one, both = self.equations, [0, 1 + pair]
        alone = replace(one, KtY=one.KtY[..., both], YtY=one.YtY[:, both][..., both])
        by_block = (alone.unexplained(block) for block in range(TIME_BLOCKS))
        return np.array([2.0 * G[0, 1] - G[1, 1] for G in by_block])


def check_exchanged_torques(filtered: FilteredLog) -> Finding | None:
    """A finding about two joints whose torques fit the model in each other's place, and only there.

    Torques are compared by the model's in the null space of contacts without a sensor, beside all parameters near the
    URDF's and friction, and relative to each joint's own, so that wrists count as much as shoulders. The exchanged log
    decides, by its own deviations: it must leave little, and the log as recorded more. Before, those of two joints of
    other sizes are wrong, which candidates by a deviation of all torques alike make up for.

    Args:
        filtered: the log.
    """
    if filtered.log.joint_torque is None or not np.isfinite(filtered.log.joint_torque).any():
        return None
    with suppress(InputError):  # reported by `check_forces_against_urdf`
        robot, noise = filtered.model.robot, _noise_of_readings(filtered)
        alike, own = filtered.rows, _rows(filtered, filtered.samples, noise)
        tried = list[tuple[int, ...]]()
        for rows in (alike, own):
            found = None if rows is None else _fit_exchanges(rows, robot)
            best = 0 if found is None else int(np.argmin(found.left))
            if found is None or tuple(found.pairs[best]) in tried or not (found.gains(best) > 0.0).all():
                continue
            pair, order = found.pairs[best], np.arange(robot.n_dofs)
            tried.append(tuple(pair))
            if not _is_told(filtered.samples, pair):
                continue
            order[pair] = pair[::-1]
            corrected = [replace(x, torque=None if x.torque is None else x.torque[:, order]) for x in filtered.samples]
            again = _rows(filtered, corrected, noise[order[: robot.n]])
            after = None if again is None else _fit_exchanges(again, robot)
            if after is not None and _is_right(after, best):
                return _finding(filtered, pair, after.left[best] / max(after.without, _TINY))
    return None


def _is_told(samples: Sequence[Samples], pair: NDArray[np.intp]) -> bool:
    """Whether two joints move at more than one rate: of a sine, either one's torques fit both."""
    parts = [torch.cat([x.joint_position, x.joint_velocity, x.joint_acceleration], 1) for x in samples]
    motion = torch.cat([x.unflatten(1, (3, -1))[..., pair.tolist()].flatten(1) for x in parts])
    motion = motion - motion.mean(0)
    size = torch.linalg.svdvals(motion / torch.linalg.vector_norm(motion, dim=0).clamp(min=_TINY))
    return bool(size[2] > _MIN_THIRD * size[0])


def _is_right(after: _Exchanges, pair: int) -> bool:
    """Whether torques fit as they are, and not if those of a pair are exchanged."""
    worse = after.left[pair] > MIN_UNEXPLAINED_RATIO * after.without and (after.gains(pair) < 0.0).all()
    return bool(worse and after.without < MAX_LEFT and abs(after.share[pair]) < _MAX_SHARE_LEFT)


def _finding(filtered: FilteredLog, pair: NDArray[np.intp], ratio: float) -> Finding:
    first, second = (filtered.model.robot.joint_names[joint] for joint in sorted(pair))
    text = f"{first} and {second} exchanged: {ratio:.2g} times as much of the torques is unexplained as once corrected"
    advice = "give torques in the order of joint_names, as positions"
    return Finding("unit, sign or frame", REJECTED, "joint_torque", text, advice, (first, second))


def _noise_of_readings(filtered: FilteredLog) -> FloatArray:
    """Standard deviation of each joint's torque readings from sample to sample (n,), in the robot's order."""
    log, names = filtered.log, filtered.model.robot.joint_names
    noise, torque = np.zeros(len(names)), np.asarray(log.joint_torque)
    for name, column in zip(log.joint_names, torque.T, strict=True):
        known = column[np.isfinite(column)]
        if name in names and len(known) >= _MIN_READINGS:
            noise[names.index(name)] = rough_noise(known[:, None]).item()
    return noise


def _rows(filtered: FilteredLog, samples: Sequence[Samples], noise: FloatArray) -> DeviationRows | None:
    """Rows of torques relative to each joint's own and to the `noise` of its readings (n,)."""
    torque = np.concatenate([x.torque[:, : len(noise)].numpy() for x in samples if x.torque is not None])
    size = np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
    return DeviationRows.of(samples, filtered.model, np.hypot(UNMODELLED_FORCE_SHARE * size, noise))


def _fit_exchanges(rows: DeviationRows, robot: Robot) -> _Exchanges | None:
    """All exchanges of the torques of two joints, None where fewer than two were measured."""
    builder, n, base = rows.builder, robot.n, robot.base_rows
    measured = (builder.sensors.torque & ~robot.is_passive)[:n]
    pairs = np.array(list(itertools.combinations(np.flatnonzero(measured).tolist(), 2)))
    if not len(pairs):
        return None
    parts = []
    for part, (W, equations, K, target) in zip(rows.samples, rows.parts, strict=True):
        read = builder.recorded_torque(part)[:, :n].numpy()
        first, second = pairs.T
        of_joints = W[:, base : base + n]
        change = (of_joints[:, first] - of_joints[:, second]) * (read[:, second] - read[:, first])[..., None]
        Y = np.concatenate([target[..., None], change.transpose(0, 2, 1)], axis=2)
        parts.append((K[..., : K.shape[2] - n], Y, equations))  # without offsets, which a load at rest may be
    normal = accumulate_blocks(parts)
    G = normal.unexplained()
    product, square = G[0, 1:], np.diag(G)[1:]
    count = max(normal.rows, 1)
    left = np.sqrt(np.maximum(G[0, 0] - 2.0 * product + square, 0.0) / count)
    share = product / np.where(square > 0.0, square, np.inf)
    return _Exchanges(pairs, share, float(np.sqrt(max(G[0, 0], 0.0) / count)), left, normal)


#: Misfit above which common mistakes are tried. A URDF that is 20 % off leaves 0.05 to 0.1, one with links missing 0.3.
MAX_MISFIT = 0.4
#: Residual of the best URDF near the given one, in `UNMODELLED_FORCE_SHARE` of the forces, up to which a misfit is not
#: reported: the moments about a standing base are small, and a centre of mass 1 cm off is a large share of them.
MAX_UNEXPLAINED_RATIO = 1.0
#: Share of the misfit that a corrected mistake may leave. Misfits above 1, that of zero forces, count as 1: forces that
#: are far too large fit better after any reduction.
MAX_FORCE_RESIDUAL_SHARE = 0.5
#: Misfit that a corrected mistake leaves, above which it may be another robot that the forces are of: 0.05 to 0.1 is a
#: URDF that is 20 % off, 0.33 was a robot of four times the weight whose torques were taken for kg m.
MAX_CLEAR_MISFIT = 0.2
#: The same, above which it may be another factor than that of a unit: those of currents are anything.
_MAX_UNIT_MISFIT = 0.1
#: Factor of time that no error of inertias explains: its square is 2.25.
MIN_TIME_FACTOR = 1.5
#: Unexplained forces with the recorded time, or at rest, over those with the corrected time.
_MIN_UNEXPLAINED_RATIO_OF_TIME = 1.5
#: The same of the recorded time where the corrected time leaves more than `MAX_UNEXPLAINED_RATIO`: an arm with a tool
#: of 2.5 kg that its URDF does not have is explained half as badly by 0.66 times the time (2.4 instead of 4.5).
_MIN_UNEXPLAINED_RATIO_OF_ANOTHER_ROBOT = 10.0
#: Factors from another unit of time to seconds, and their tolerance.
TIME_UNIT_FACTORS = {60.0: "minutes", 1e-3: "ms", 1e3: "ks", 3600.0: "hours"}
_TIME_UNIT_TOLERANCE = 0.1
_FORCE_CHECK = "forces against the model"


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
        derived: how names of fields begin that were not recorded and hold no mistake of a recording.
        declared: what is known of the sensors.
        required: sensors of a fit, which must be in the log.
    """
    if robot is None:
        yield Skipped(_FORCE_CHECK, "no robot (--urdf)")
        return
    cutoff, model = cutoff_hz or default_cutoff_hz(log), NominalModel(robot, contacts, declared or Declared())
    try:
        log = with_delayed_torques(log, model.declared.known_delay)
        logs = preprocess_pieces(log, cutoff)
    except InputError as error:  # too short, or sampled too slowly by its time stamps
        skipped = Skipped(_FORCE_CHECK, f"{error.field}: {error.found}") if required is None else refused(error)
        yield _time_scale_finding(_fit_time_scale(log, model)) or skipped
        return
    try:
        samples = bind_some_samples(logs, robot, contacts)
    except InputError as error:
        yield refused(error)
        return
    if required is not None:
        yield from check_required(samples, robot, contacts, required, model.declared.goes_on_without_base)
    if log.joint_torque is None and log.contact_wrench is None:
        yield Skipped(_FORCE_CHECK, "neither joint torques nor contact wrenches")
    else:
        yield from _misfit_findings(log, samples, model, cutoff, derived)


def _misfit_findings(
    log: Log, samples: Sequence[Samples], model: NominalModel, cutoff: float, derived: tuple[str, ...]
) -> Iterator[Finding | Skipped]:
    """The mistake that explains forces unlike the URDF's, or single deviations of forces that are like them."""
    fit, robot = model.compare(samples), model.robot
    if fit.largest_misfit > MAX_MISFIT and (bare := without_friction(robot)) is not None:
        without = replace(model, robot=bare)
        better = without.compare(samples)
        if better.largest_misfit <= MAX_MISFIT or _is_mostly_friction(fit, better):
            yield _friction_finding(robot, fit, better)
            robot, model, fit = bare, without, better
    filtered = FilteredLog(log, model, cutoff)
    explanation = _explanation(filtered, fit, derived)
    if explanation is not None:
        yield explanation
        return
    if fit.torque is not None and fit.torque.driving.any():  # which no lag, tilt or zero does
        yield from torque_findings(robot, fit.torque)
        return
    log, samples = _scaled(log, samples, robot, fit.torque)
    filtered = filtered if log is filtered.log else FilteredLog(log, model, cutoff)
    if model.declared.delay == AUTO:
        filtered = without_lag(filtered)
        log = filtered.log
    moved, unexplained = check_lag_and_tilt(filtered, derived)
    moved = check_encoders(filtered, moved, unexplained)
    scale = None if moved else _fit_time_scale(log, model)
    if found := moved or [one for one in [_time_scale_finding(scale)] if one is not None]:
        alike = None if moved else fit_torque_gains(samples, model)
        yield from (alike and list(common_gain_findings(alike, robot))) or found
        return
    unexplained = unexplained if scale is None else min(unexplained, scale.recorded)
    if fit.largest_misfit > MAX_MISFIT and unexplained > MAX_UNEXPLAINED_RATIO:
        held = bool(model.contacts) or robot.fixed_base
        gains = fit_torque_gains(samples, model) if held else None
        found = list(gain_and_point_findings(log, gains, robot)) or single_zero_findings(filtered)
        yield from found or [_contradiction(fit, robot, held)]
        return
    torques = [] if fit.torque is None else list(torque_findings(robot, fit.torque))
    yield from torques
    if not any(isinstance(item, Finding) for item in torques):
        scaled = list(gain_and_point_findings(log, fit_torque_gains(samples, model), robot))
        found = scaled or single_zero_findings(filtered) or list(check_torque_offsets(filtered))
        yield from found or (common_factor_notes(filtered) if is_bolted_arm(model) else [])


def _explanation(filtered: FilteredLog, fit: ModelFit, derived: tuple[str, ...]) -> Finding | None:
    """The one mistake that explains forces unlike the model's; gravity along other axes is nearly right."""
    log, model = filtered.log, filtered.model
    if (exchanged := check_exchanged_torques(filtered)) is not None:
        return exchanged
    if fit.largest_misfit <= MAX_MISFIT:
        turned = _corrected_logs(filtered, accelerometer_axes(log, model.robot), derived)
        return _mistake_beside_urdf(filtered, list(turned), least=0.0)
    of_joints = joint_mistakes(log) if is_bolted_arm(model) else ()
    possible = [x for x in (*possible_mistakes(log, model.robot), *of_joints) if _may_explain(x.field, fit)]
    trials = list(_corrected_logs(filtered, possible, derived))
    return _best_mistake(model, fit, trials) or _mistake_beside_urdf(filtered, trials)


def _is_mostly_friction(stated: ModelFit, without: ModelFit) -> bool:
    """Whether most of what torques differ by is friction that the robot's file states, whatever else is wrong."""
    if stated.torque is None or without.torque is None:
        return False
    return (
        without.torque.misfit * without.torque.size
        < MAX_FORCE_RESIDUAL_SHARE * stated.torque.misfit * stated.torque.size
    )


def _contradiction(fit: ModelFit, robot: Robot, held: bool) -> Finding:
    """A finding about forces that no usual mistake explains; `held`: whether anything is known to hold the robot."""
    text = f"measured forces differ from the {robot.format}'s by {_percent(fit.largest_misfit)}{UNEXPLAINED}"
    advice = f"check units, frames, the order of joints and contacts, friction, the {robot.format}'s base link and"
    advice += f" masses, and whether the {robot.format} is that of this robot"
    if not held:
        advice = f"name under contacts what touches the ground, or holds the base in the air; or {advice}"
    return Finding("forces", SUSPICIOUS, "all", text, advice)


def _scaled(log: Log, samples: Sequence[Samples], robot: Robot, fit: TorqueFit | None) -> tuple[Log, Sequence[Samples]]:
    """A log and samples of it, of torques times the declared unknown scales that fit best."""
    if fit is None or log.joint_torque is None or (fit.scale == 1.0).all():
        return log, samples
    by_name = dict(zip((robot.joint_names[joint] for joint in fit.joints), fit.scale, strict=True))
    factor = np.array([by_name.get(name, 1.0) for name in log.joint_names])
    of_dofs = torch.tensor([by_name.get(name, 1.0) for name in robot.dof_names])
    scaled = [replace(x, torque=None if x.torque is None else x.torque * of_dofs) for x in samples]
    return replace(log, joint_torque=log.joint_torque * factor), scaled


def _friction_finding(robot: Robot, stated: ModelFit, without: ModelFit) -> Finding:
    """Friction in the robot's file that the forces contradict, and nothing else; the largest of each kind is named."""
    largest = []
    for number, kind in ((COULOMB, "Coulomb"), (VISCOUS, "viscous")):
        body = robot.bodies[int(np.argmax(np.abs(robot.nominal[:, number])))]
        if (value := robot.nominal[robot.bodies.index(body), number]) and body.joint is not None:
            largest.append(f"{kind} up to {value:g} in {body.joint.name}")
    text = f"measured forces differ from the {robot.format}'s by {_percent(stated.largest_misfit)}"
    if without.largest_misfit <= MAX_MISFIT:
        text += f", by {_percent(without.largest_misfit)} without the friction that it states"
    else:
        text += ", mostly by the friction that it states"
    text += f": {', '.join(largest)}"
    return Finding("friction", NOTE, "all", text, f"nothing, as a fit finds friction; or 0 in the {robot.format}")


@dataclass(frozen=True, eq=False)
class _Corrected:
    """A usual mistake, and some samples of the log without it."""

    mistake: Mistake
    samples: Sequence[Samples]


def _corrected_logs(whole: FilteredLog, mistakes: Iterable[Mistake], derived: tuple[str, ...]) -> Iterator[_Corrected]:
    """The log without each of some mistakes, where the filter accepts it then."""
    log, model, cutoff = whole.log, whole.model, whole.cutoff_hz
    for mistake in mistakes:
        if mistake.field.startswith(derived):
            continue
        try:
            if mistake.after_filter:
                pieces = [mistake.correct(piece) for piece in whole.pieces]
            else:
                pieces = preprocess_pieces(mistake.correct(log), cutoff, MAX_TRIAL_DIFFERENTIATED_SAMPLES)
            yield _Corrected(mistake, bind_some_samples(pieces, model.robot, model.contacts, TRIAL_SAMPLES))
        except InputError:
            continue


def _best_mistake(model: NominalModel, fit: ModelFit, trials: Sequence[_Corrected]) -> Finding | None:
    """The mistake whose correction leaves the least misfit, if that is small enough: one of torques, by the torques."""
    robot, best, least, shares = model.robot, None, min(fit.misfit, 1.0), (0.0, 0.0)
    for one in trials:
        mistake, of_torques = one.mistake, one.mistake.field == "joint_torque"
        trial = model.compare(
            one.samples, least if of_torques else min(least, MAX_FORCE_RESIDUAL_SHARE * min(fit.misfit, 1.0))
        )
        if trial.compared != fit.compared or (of_torques and trial.implausible > fit.implausible):
            continue  # compare the same forces only
        if of_torques and trial.mostly_implausible:
            continue  # corrected one by one they fit after any factor
        if mistake.of_joint and trial.reversed:
            continue  # the torque tells which way its joint turns
        before, after = (x.torque_misfit or 0.0 if of_torques else x.misfit for x in (fit, trial))
        if after < MAX_FORCE_RESIDUAL_SHARE * min(before, 1.0) and trial.misfit < least:
            best, least, shares = mistake, trial.misfit, (before, after)
    if best is None:
        return None
    before, after = shares
    measured = "torques" if best.field == "joint_torque" else "forces"
    text = f"measured {measured} differ from the {robot.format}'s by {_percent(before)}"
    text += f", by {_percent(after)} once corrected"
    of_currents = best.field == "joint_torque" and best.description.startswith("in ") and after > _MAX_UNIT_MISFIT
    advice = best.advice + "; of currents, set sensors.scales: {joint_torque: all}" * of_currents
    advice += f"; or is {robot.path.name} another robot's?" * (after > MAX_CLEAR_MISFIT)
    return Finding("unit, sign or frame", REJECTED, best.field, f"{best.description}: {text}", advice)


def _mistake_beside_urdf(
    filtered: FilteredLog, trials: Sequence[_Corrected], least: float = MAX_UNEXPLAINED_RATIO
) -> Finding | None:
    """The mistake without which a URDF near the given one explains the forces.

    The misfit of the given one does not show it where small forces are far off without any mistake: moments about a
    base that stands or flies upright are those of a centre of mass that is 1 cm off.
    """
    rows, model = filtered.rows, filtered.model
    if not trials or rows is None or rows.unexplained <= least:
        return None
    corrected = ((DeviationRows.of(one.samples, model), one.mistake) for one in trials)
    left = sorted(((x.unexplained, one) for x, one in corrected if x is not None), key=lambda pair: pair[0])
    if not left or left[0][0] > min(MAX_LEFT, MAX_FORCE_RESIDUAL_SHARE * rows.unexplained):
        return None
    of_best, best = left[0]
    ratio = rows.unexplained / max(of_best, _TINY)
    text = f"{best.description}: {ratio:.2g} times as much of the forces is unexplained as once corrected"
    for other_left, other in left[1:]:
        if other_left < MIN_UNEXPLAINED_RATIO * of_best and other.description != best.description:
            text += f"; or {other.field} {other.description}, which explains as much"
    return Finding("unit, sign or frame", REJECTED, best.field, text, best.advice)


def _may_explain(field: str, fit: ModelFit) -> bool:
    """Whether a field can cause the misfit: torques and wrenches only their own, positions and base motion both."""
    misfits = {"joint_torque": fit.torque_misfit, **dict.fromkeys(WRENCHES, fit.wrench_misfit)}
    if field in misfits:
        return (misfits[field] or 0.0) > MAX_MISFIT
    return all(misfit is None or misfit > MAX_MISFIT for misfit in misfits.values())


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %" if share < 10.0 else f"{share:.3g} times their size"


def _fit_time_scale(log: Log, model: NominalModel) -> TimeScale | None:
    """The scale of time by the forces; None where nothing moves, or the log is too short."""
    cutoff = motion_cutoff_hz(log)
    try:
        return None if cutoff is None else fit_time_scale(log, model, cutoff)
    except InputError:
        return None


def _time_scale_finding(scale: TimeScale | None) -> Finding | None:
    """Time is in another unit: gravity and inertia explain the forces in that unit only.

    Noise of positions makes accelerations without forces, as time stamps that are too dense do. The corrected time
    must therefore also explain the forces better than a robot at rest. Gravity and inertia that do not make up the
    forces in any time are those of another robot or load, whose inertias a factor of time makes up in part.
    """
    if scale is None:
        return None
    factor, log_factor = scale.factor, np.log(scale.factor)
    agree = np.log(scale.blocks) * np.sign(log_factor) > MIN_BLOCK_SHARE * abs(log_factor)
    improves = min(scale.recorded, scale.at_rest) >= _MIN_UNEXPLAINED_RATIO_OF_TIME * scale.corrected
    makes_up = scale.corrected <= MAX_UNEXPLAINED_RATIO
    makes_up |= scale.recorded >= _MIN_UNEXPLAINED_RATIO_OF_ANOTHER_ROBOT * scale.corrected
    if abs(log_factor) < np.log(MIN_TIME_FACTOR) or not agree.all() or not improves or not makes_up:
        return None
    units = [name for size, name in TIME_UNIT_FACTORS.items() if abs(factor / size - 1.0) < _TIME_UNIT_TOLERANCE]
    prefix = f"in {units[0]}: " if units else ""
    text = f"{prefix}gravity and inertia make up the measured forces if time is multiplied by {factor:.3g}"
    advice = "give seconds; check the sample rate that the stamps were made from"
    return Finding("unit", REJECTED, "time", text, advice)
