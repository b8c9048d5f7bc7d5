"""Measured forces against the URDF's: signs, units, and which usual mistake explains what does not fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError
from torchid.hygiene.factors import factor_findings, time_finding, time_fit
from torchid.hygiene.finding import CONDEMNED, SUSPICIOUS, Finding, Skipped
from torchid.hygiene.mistakes import mistakes
from torchid.hygiene.model import (
    DIFFERENTIATED_TO_TRY,
    TRIED,
    ModelFit,
    TorqueFit,
    bound,
    filtered,
    model_fit,
    usual_cutoff,
)
from torchid.logs import Log
from torchid.logs.fields import WRENCHES, FloatArray
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.text import listed

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


def forces(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about joint torques and contact wrenches; `cutoff_hz` is that of the fit, None for a usual one."""
    if robot is None:
        yield Skipped(_NAME, "no robot (--urdf)")
        return
    cutoff = cutoff_hz or usual_cutoff(log)
    try:
        logs = filtered(log, cutoff)
    except InputError as error:  # too short, or too fast: by its stamps
        yield time_finding(time_fit(log, robot, contacts)) or Skipped(_NAME, f"{error.field}: {error.found}")
        return
    try:
        samples = bound(logs, robot, contacts)
    except InputError as error:
        yield Finding("does not fit", CONDEMNED, error.field, error.found, f"give {error.accepted}")
        return
    if log.joint_torque is None and log.contact_wrench_local is None and log.contact_wrench_world is None:
        yield Skipped(_NAME, "neither joint torques nor contact wrenches")
        return
    fit = model_fit(samples, robot, contacts)
    wrong = _explained(log, robot, contacts, cutoff, fit) if fit.misfit > WRONG else None
    timed = time_fit(log, robot, contacts) if wrong is None else None
    wrong = wrong or time_finding(timed)
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
        yield from factor_findings(log, samples, robot, contacts)


def _explained(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff: float, fit: ModelFit) -> Finding | None:
    """The mistake that leaves the least misfit, if it leaves much less."""
    best, least = None, BETTER * min(fit.misfit, 1.0)
    for mistake in mistakes(log):
        if not _may_explain(mistake.field, fit):
            continue
        try:
            samples = bound(filtered(mistake.mended(log), cutoff, DIFFERENTIATED_TO_TRY), robot, contacts, TRIED)
        except InputError:  # a mended log may be too fast for the filter: then that was not the mistake
            continue
        found = model_fit(samples, robot, contacts)
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
    return listed([f"{gain:.3g}" for gain in gains])


def _signs(log: Log, robot: Robot, fit: TorqueFit) -> Iterator[Finding | Skipped]:
    names = np.array(robot.joint_names)[fit.joints]
    reversed_ = fit.wrong & (fit.gain < 0.0)
    if reversed_.any():
        chosen = [str(name) for name in names[reversed_]]
        text = f"{listed(chosen)}: reversed; factors that fit the URDF best: {_gains(fit.gain[reversed_])}"
        yield Finding("sign", CONDEMNED, "joint_torque", text, "reverse these torques", tuple(chosen))
    other_unit = np.zeros(len(names), bool)
    for factor, unit in UNITS.items():
        here = fit.wrong & (fit.gain > factor / _UNIT_WITHIN) & (fit.gain < factor * _UNIT_WITHIN)
        if here.any():
            other_unit |= here
            chosen = [str(name) for name in names[here]]
            text = f"{listed(chosen)}: {unit}; factors that fit the URDF best: {_gains(fit.gain[here])}"
            yield Finding("unit", CONDEMNED, "joint_torque", text, f"multiply by {factor:g}", tuple(chosen))
    scaled = fit.wrong & ~reversed_ & ~other_unit
    if scaled.any():
        chosen = [str(name) for name in names[scaled]]
        text = f"{listed(chosen)}: factors that fit the URDF best: {_gains(fit.gain[scaled])}"
        advice = "look at gear ratios, torque constants and units"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(chosen))
    if not fit.clear.all():
        open_ = listed([str(name) for name in names[~fit.clear]])
        yield Skipped("sign of torques", f"too little in this motion but friction and noise: {open_}")
