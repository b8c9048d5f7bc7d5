"""Measured forces against the URDF's: signs, units, scales, and which usual mistake explains what does not fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError, join_names
from torchid.log_checks.findings import CONDEMNED, SUSPICIOUS, Finding, Skipped
from torchid.log_checks.mistakes import possible_mistakes
from torchid.log_checks.model import (
    DIFFERENTIATED_TO_TRY,
    TRIED,
    ModelFit,
    TorqueFit,
    bind_some_samples,
    default_cutoff_hz,
    fit_nominal_model,
    preprocess_pieces,
)
from torchid.log_checks.scales import TimeScale, TorqueGains, fit_time_scale, fit_torque_gains, motion_cutoff_hz
from torchid.logs import Log
from torchid.logs.log import WRENCHES, BoolArray, FloatArray
from torchid.problem import Samples
from torchid.robot import Robot
from torchid.sensing import Contact

#: Misfit above which usual mistakes are tried. A URDF that is 20 % off leaves 0.05 to 0.1, one with links missing 0.3.
WRONG = 0.4
#: What no URDF near the given one explains, in `UNMODELLED` of the forces, below which there is nothing to complain of:
#: moments about the base of a robot that stands are small, so that a centre of mass 1 cm off is a large share of them.
NEAR = 1.0
#: Share of the misfit that a mistake must leave to be the explanation; of 1 at most, which no forces at all leave: what
#: is far too large fits better by any factor that makes it small.
BETTER = 0.5
#: Factor of single torques in another unit, and by which factor it may be missed: see `SCALE` in `model`.
UNITS = {1e-3: "in mN m", 1e3: "in kN m"}
_UNIT_WITHIN = 3.0
_NAME = "forces against the URDF"


def check_forces_against_urdf(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about joint torques and contact wrenches; `cutoff_hz` is that of the fit, None for a usual one."""
    if robot is None:
        yield Skipped(_NAME, "no robot (--urdf)")
        return
    cutoff = cutoff_hz or default_cutoff_hz(log)
    try:
        logs = preprocess_pieces(log, cutoff)
    except InputError as error:  # too short, or too fast: by its stamps
        yield _time_scale_finding(_fit_time_scale_of_log(log, robot, contacts)) or Skipped(
            _NAME, f"{error.field}: {error.found}"
        )
        return
    try:
        samples = bind_some_samples(logs, robot, contacts)
    except InputError as error:
        yield Finding("does not fit", CONDEMNED, error.field, error.found, f"give {error.accepted}")
        return
    if log.joint_torque is None and log.contact_wrench is None:
        yield Skipped(_NAME, "neither joint torques nor contact wrenches")
        return
    fit = fit_nominal_model(samples, robot, contacts)
    wrong = _explained(log, robot, contacts, cutoff, fit) if fit.misfit > WRONG else None
    timed = _fit_time_scale_of_log(log, robot, contacts) if wrong is None else None
    wrong = wrong or _time_scale_finding(timed)
    if wrong is None and fit.misfit > WRONG and (timed is None or timed.recorded > NEAR):
        text = f"{_apart(fit)}, and no usual mistake explains it"
        advice = "look at units, frames, the order of joints and contacts, friction, the URDF's base link and masses"
        wrong = Finding("forces", SUSPICIOUS, "all", text, advice)
    if wrong is not None:
        yield wrong
        return
    signs = [] if fit.torque is None else list(_signs(log, robot, fit.torque))
    yield from signs
    if not any(isinstance(one, Finding) for one in signs):
        yield from _gain_and_point_findings(log, samples, robot, contacts)


def _explained(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff: float, fit: ModelFit) -> Finding | None:
    """The mistake that leaves the least misfit, if it leaves much less."""
    best, least = None, BETTER * min(fit.misfit, 1.0)
    for mistake in possible_mistakes(log):
        if not _may_explain(mistake.field, fit):
            continue
        try:
            samples = bind_some_samples(
                preprocess_pieces(mistake.corrected(log), cutoff, DIFFERENTIATED_TO_TRY), robot, contacts, TRIED
            )
        except InputError:  # a corrected log may be too fast for the filter: then that was not the mistake
            continue
        found = fit_nominal_model(samples, robot, contacts)
        if found.known == fit.known and found.misfit < least:  # a mistake must not win by forces that it makes unknown
            best, least = mistake, found.misfit
    if best is None:
        return None
    text = f"{best.found}: {_apart(fit)}, by {_percent(least)} once corrected"
    return Finding("unit, sign or frame", CONDEMNED, best.field, text, best.advice)


def _may_explain(field: str, fit: ModelFit) -> bool:
    """Whether a field is to blame at all: torques and wrenches for their own misfit each, the motion for both."""
    misfits = {"joint_torque": fit.of_torques, **dict.fromkeys(WRENCHES, fit.of_wrenches)}
    if field in misfits:
        return (misfits[field] or 0.0) > WRONG
    return all(misfit is None or misfit > WRONG for misfit in misfits.values())


def _apart(fit: ModelFit) -> str:
    return f"measured forces miss the URDF's by {_percent(fit.misfit)}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %" if share < 10.0 else f"{share:.3g} times their size"


def _gains(gains: FloatArray) -> str:
    return join_names([f"{gain:.3g}" for gain in gains])


def _signs(log: Log, robot: Robot, fit: TorqueFit) -> Iterator[Finding | Skipped]:
    names = np.array(robot.joint_names)[fit.joints]
    reversed_ = fit.wrong & (fit.gain < 0.0)
    if reversed_.any():
        chosen = [str(name) for name in names[reversed_]]
        text = f"{join_names(chosen)}: reversed; factors that fit the URDF best: {_gains(fit.gain[reversed_])}"
        yield Finding("sign", CONDEMNED, "joint_torque", text, "reverse these torques", tuple(chosen))
    other_unit = np.zeros(len(names), bool)
    for factor, unit in UNITS.items():
        here = fit.wrong & (fit.gain > factor / _UNIT_WITHIN) & (fit.gain < factor * _UNIT_WITHIN)
        if here.any():
            other_unit |= here
            chosen = [str(name) for name in names[here]]
            text = f"{join_names(chosen)}: {unit}; factors that fit the URDF best: {_gains(fit.gain[here])}"
            yield Finding("unit", CONDEMNED, "joint_torque", text, f"multiply by {factor:g}", tuple(chosen))
    scaled = fit.wrong & ~reversed_ & ~other_unit
    if scaled.any():
        chosen = [str(name) for name in names[scaled]]
        text = f"{join_names(chosen)}: factors that fit the URDF best: {_gains(fit.gain[scaled])}"
        advice = "look at gear ratios, torque constants and units"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(chosen))
    if not fit.clear.all():
        open_ = join_names([str(name) for name in names[~fit.clear]])
        yield Skipped("sign of torques", f"too little in this motion but friction and noise: {open_}")


# ------------------------------------------------------ scales of time and of single torques, and the point of wrenches

#: Factor of time from which on no error of inertias is to blame: its square is 2.25. Blocks must agree on `SAME` of it.
STRETCHED = 1.5
#: How much more of the forces stays unexplained with the recorded time than with the corrected one.
WORSE = 1.5
#: Units of time, by what turns them to seconds.
SCALE_UNITS = {60.0: "minutes", 1e-3: "ms", 1e3: "ks", 3600.0: "hours"}
_SCALE_UNIT_WITHIN = 0.1
#: Factor of a torque against those of the other joints, and shift of a point [m], from which on they are worth a word:
#: what gears and calibrations are off by is less.
GAIN, POINT = 1.15, 0.03
#: How many standard deviations, errors of the URDF among them, they must be off.
CERTAIN = 4.0
#: Share of it that every block of time must find.
SAME = 0.5
#: Factors with a standard deviation below this are what others are compared with, if there are so many.
_KNOWN, _ENOUGH = 0.1, 3


def _fit_time_scale_of_log(log: Log, robot: Robot, contacts: Sequence[Contact]) -> TimeScale | None:
    """What time is worth by the forces; None where nothing moves, or the log is too short."""
    cutoff = motion_cutoff_hz(log)
    try:
        return None if cutoff is None else fit_time_scale(log, robot, contacts, cutoff)
    except InputError:
        return None


def _time_scale_finding(found: TimeScale | None) -> Finding | None:
    """That time is in another unit, if gravity and inertia only make up the forces in that unit.

    Noise in positions makes accelerations that no force answers to, which looks like time that is too short: so inertia
    must matter at the corrected time.
    """
    if found is None:
        return None
    factor, log_factor = found.factor, np.log(found.factor)
    agree = np.log(found.blocks) * np.sign(log_factor) > SAME * abs(log_factor)
    other = min(found.recorded, found.still)
    if abs(log_factor) < np.log(STRETCHED) or not agree.all() or other < WORSE * found.corrected:
        return None
    unit = next((name for size, name in SCALE_UNITS.items() if abs(factor / size - 1.0) < _SCALE_UNIT_WITHIN), None)
    text = f"in {unit}: " if unit else ""
    text += f"gravity and inertia make up the measured forces if time is multiplied by {factor:.3g}"
    advice = "give seconds; look at the sample rate that the stamps were made from"
    return Finding("unit", CONDEMNED, "time", text, advice)


def _gain_and_point_findings(
    log: Log, samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]
) -> Iterator[Finding]:
    """Findings about torques of another size and wrenches about another point."""
    found = fit_torque_gains(samples, robot, contacts)
    if found is None:
        return
    yield from _gain_findings(found, robot)
    m = len(found.joints)
    off = _sure(found.point, found.spread[m:], found.blocks[:, m:]) & (np.abs(found.point) > POINT)
    if off.any():
        field = log.contact_wrench_field
        where = ", ".join(f"{1e3 * x:.0f}" for x in found.point)
        text = f"forces and moments fit the URDF about a point that lies {where} mm from the contact frames' origins"
        advice = "give moments about the contact frame's origin, or name the sensor's own frame as the contact"
        yield Finding("point", SUSPICIOUS, field, text, advice)


def _gain_findings(found: TorqueGains, robot: Robot) -> Iterator[Finding]:
    m = len(found.joints)
    spread = found.spread[:m]
    known = spread < _KNOWN
    usual = float(np.median(found.gain[known])) if known.sum() >= _ENOUGH else 1.0
    relative, blocks = found.gain / usual, found.blocks[:, :m] / usual
    large = (relative > GAIN) | (relative < 1.0 / GAIN)
    off = large & _sure(relative - 1.0, spread / usual, blocks - 1.0)
    if off.any():
        names = [robot.joint_names[joint] for joint in found.joints[off]]
        factors = join_names([f"{gain:.3g} +- {sd:.2g}" for gain, sd in zip(relative[off], spread[off], strict=True)])
        text = f"{join_names(names)}: factors that fit the URDF best, against the other joints: {factors}"
        advice = "look at gear ratios, torque constants and units; at friction and inertias of the URDF there"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(names))


def _sure(value: FloatArray, spread: FloatArray, blocks: FloatArray) -> BoolArray:
    """Which values (k,) are not 0, by their standard deviations (k,) and by blocks (BLOCKS, k)."""
    return np.asarray((np.abs(value) > CERTAIN * spread) & (blocks * np.sign(value) > SAME * np.abs(value)).all(axis=0))
