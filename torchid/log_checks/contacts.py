"""Contacts against their flags: forces, feet that stand and must not move, limb sensors while nothing touches."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.errors import InputError, format_count
from torchid.log_checks.findings import (
    CONDEMNED,
    NORMAL,
    NOTE,
    SUSPICIOUS,
    Finding,
    Skipped,
    Span,
    find_spans,
    median_step,
)
from torchid.log_checks.mistakes import Mistake, possible_mistakes
from torchid.log_checks.model import COMPARED, bind_some_samples, default_cutoff_hz, link_poses, preprocess_pieces
from torchid.log_checks.weight import GRAVITY, WRONG_MASS
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.quaternion import rotate_to_world
from torchid.problem import RowBuilder
from torchid.problem.predict import force_series
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

# ------------------------------------------------------------------------------------------------- flags against forces

#: Share of the weight that an inactive contact must not carry. Thresholds of flags are 20 to 50 N, for 60 kg 3 to 8 %.
LOADED = 0.1
#: Share of the weight below which an active contact carries nothing.
UNLOADED = 0.005
#: Seconds for which a contact may be active without a force: a filter widens flags by as much.
_PATIENCE = 0.1
#: Share of an offset in the air that may vary for it to be one, samples that it takes, and the share of the usual load
#: from which on it is no offset but a foot that stands.
_STEADY, _FEW_TOUCHING, _OF_LOAD = 0.2, 10, 0.5
#: Samples between the change of a flag and that of the force, and over how many seconds to look for the latter.
LATE, _SEARCH = 2, 0.2
#: Changes it takes to speak of a delay, and share of them that must agree to a sample or two.
_FEWEST, _AGREE = 3, 0.7
_TOUCHING = "contact flags against forces"


@dataclass(frozen=True, eq=False)
class _Contact:
    name: str
    active: BoolArray
    force: FloatArray  # (N, 3) [N], NaN where it was not read


def check_contact_flags(log: Log) -> Iterator[Finding | Skipped]:
    """Findings about contacts, by what they carry together: forces may be in any unit."""
    if not log.contact_names:
        return
    contacts = list(_contacts(log))
    if not contacts:
        yield Skipped(_TOUCHING, "no contact whose force was measured whenever it touches")
        return
    judged = {contact.name for contact in contacts}
    for name in (name for name in log.contact_names if name not in judged):
        yield Skipped(_TOUCHING, f"{name}: its force was not measured whenever it touches")
    weight = _largest_load(contacts)
    if not weight > 0.0:
        yield Skipped(_TOUCHING, "all contact forces are zero")
        return
    for contact in contacts:
        offset = _offset(contact)
        size = np.linalg.norm(contact.force - offset, axis=1)
        if (steady := float(np.linalg.norm(offset))) > UNLOADED * weight:
            text = f"{contact.name}: reads a steady {steady:.3g} N in the air"
            advice = "identify it, sensors.offsets: {contact_force: log}, or subtract it"
            yield Finding("offset", NOTE, "contact_wrench", text, advice, (contact.name,))
        yield from _contradictions(log, contact, size, weight)
        yield from _delay(log, contact, size, weight)


def _contacts(log: Log) -> Iterator[_Contact]:
    """Those whose force can be judged: NaN stands for no reading, which a contact may lack while it is in the air."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return
    for index, name in enumerate(log.contact_names):
        force, active = wrench[:, index, :3], log.contact_active[:, index]
        read = np.asarray(np.isfinite(force).all(axis=1))
        if read.any() and read[active].all():
            yield _Contact(name, active, np.where(read[:, None], force, np.nan))


def _largest_load(contacts: list[_Contact]) -> float:
    """What all contacts carry together when they carry much [N]: about the weight of a robot that stands."""
    sizes = [np.where(contact.active, np.linalg.norm(contact.force, axis=1), 0.0) for contact in contacts]
    total = np.sum(sizes, axis=0)
    return float(np.percentile(total, 90.0))


def subtract_contact_offsets(log: Log) -> Log:
    """The log with what contact sensors read steadily in the air taken off."""
    offsets = {contact.name: _offset(contact) for contact in _contacts(log)}
    field = log.contact_wrench_field
    if not any(np.any(offset) for offset in offsets.values()):
        return log
    wrench = getattr(log, field).copy()
    for name, offset in offsets.items():
        wrench[:, log.contact_names.index(name), :3] -= offset
    return dataclasses.replace(log, **{field: wrench})


def _offset(contact: _Contact) -> FloatArray:
    """What the sensor reads steadily in the air, (3,) [N]; 0 where it does not."""
    air = contact.force[~contact.active & np.isfinite(contact.force[:, 0])]
    if len(air) < _FEW_TOUCHING or not contact.active.any():
        return np.zeros(3)
    offset = np.median(air, axis=0)
    spread = NORMAL * float(np.median(np.linalg.norm(air - offset, axis=1)))
    size, load = float(np.linalg.norm(offset)), float(np.median(np.linalg.norm(contact.force[contact.active], axis=1)))
    return offset if spread < _STEADY * size and size < _OF_LOAD * load else np.zeros(3)


def _contradictions(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Forces without a contact, and contacts without a force."""
    loaded = ~contact.active & (size > LOADED * weight)
    if loaded.any():
        samples = format_count(int(loaded.sum()), "sample")
        text = f"{contact.name}: inactive with up to {size[loaded].max():.3g} N, in {samples}"
        advice = "set the flag where there is a force: what an inactive contact exerts is not counted"
        spans = tuple(find_spans(loaded, contact.name))
        yield Finding("force without contact", CONDEMNED, "contact_active", text, advice, (contact.name,), spans)
    patience = max(1, round(_PATIENCE / median_step(log)))
    light = contact.active & (size < UNLOADED * weight)
    spans = tuple(span for span in find_spans(light, contact.name) if len(span) > patience)
    if spans:
        samples = format_count(sum(len(span) for span in spans), "sample")
        never = " though the flag never changes" if contact.active.all() else ""
        text = f"{contact.name}: active without a force (below {UNLOADED * weight:.2g} N) in {samples}{never}"
        advice = "costs data, not truth; clear the flag where the foot is in the air"
        yield Finding("contact without force", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


def _delay(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Whether the flag changes earlier or later than the force does."""
    touches = size > 0.5 * LOADED * weight
    flags, forces = (np.flatnonzero(np.diff(x.astype(np.int8))) for x in (contact.active, touches))
    if len(flags) < _FEWEST or len(forces) < _FEWEST or len(log) < 3:
        return
    search = max(LATE + 1, round(_SEARCH / median_step(log)))
    rising = contact.active[flags + 1]
    shifts = []
    for flag, up in zip(flags, rising, strict=True):
        same = forces[touches[forces + 1] == up]
        nearest = same[np.argmin(np.abs(same - flag))] if len(same) else flag + search + 1
        if abs(nearest - flag) <= search:
            shifts.append((int(flag - nearest), bool(up)))
    early = np.array([shift for shift, up in shifts if up] or [0])
    late = np.array([shift for shift, up in shifts if not up] or [0])
    typical = [float(np.median(x)) for x in (early, late)]
    agree = np.mean([abs(shift - typical[0 if up else 1]) <= LATE for shift, up in shifts]) if shifts else 0.0
    if len(shifts) < _FEWEST or agree < _AGREE or typical[0] * typical[1] <= 0.0 or min(map(abs, typical)) < LATE:
        return
    shift = float(np.mean(typical))
    text = f"{contact.name}: the flag changes {abs(shift):.3g} samples {'after' if shift > 0 else 'before'} the force"
    spans = tuple(Span(int(i), int(i) + 1, contact.name) for i in flags)
    advice = "shift contact_active, or derive it from the forces"
    yield Finding("delay", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


# ------------------------------------------------------------------------------------------------------ feet that stand

#: Motion of standing feet, in that of the base above them, from which on mistakes are tried; soft soles and feet that
#: roll leave 0.05 to 0.2.
MOVES = 0.3
#: Share of it that a mistake must leave to be the explanation.
BETTER = 1.0 / 3.0
#: Time [s] at either end of a stance that heel and toe take, and the shortest stance that is left to be judged.
_ENDS, _SHORTEST = 0.05, 0.15
#: Samples used, and how much the base must move above its feet [rad, and 0.3 m] for the check to be meaningful.
_SAMPLES, _STILL = 1500, 0.01
_LENGTH = 0.3
_FIELDS = ("joint_names", "joint_position", "base_quat_xyzw", "contact_names", "contact_active")
_STANDING = "feet that stand"


def check_standing_feet(log: Log, robot: Robot | None, contacts: Sequence[Contact]) -> Iterator[Finding | Skipped]:
    """Findings about what moves feet whose flag says that they stand."""
    if robot is None or not contacts or robot.fixed_base:
        return
    log = _thinned(log)
    moves = measure_foot_slip(log, robot, contacts)
    if moves is None:
        yield Skipped(_STANDING, "no orientation of the base, or no stance above which the base moves")
        return
    if moves < MOVES:
        return
    best, least = None, BETTER * moves
    for mistake in possible_mistakes(log):
        if mistake.field in _FIELDS and (found := _after(mistake, log, robot, contacts)) is not None and found < least:
            best, least = mistake, found
    if best is not None:
        share = (
            f"standing feet move {100 * moves:.3g} % as much as the base above them, {100 * least:.2g} % once corrected"
        )
        yield Finding("unit, sign or frame", CONDEMNED, best.field, f"{best.found}: {share}", best.advice)


def _after(mistake: Mistake, log: Log, robot: Robot, contacts: Sequence[Contact]) -> float | None:
    return measure_foot_slip(mistake.corrected(log), robot, contacts)


def _thinned(log: Log) -> Log:
    """Evenly spread samples."""
    every = max(1, len(log) // _SAMPLES)
    return log.select(slice(None, None, every))


def measure_foot_slip(log: Log, robot: Robot, contacts: Sequence[Contact]) -> float | None:
    """Motion of standing feet in the world as a share of that in the base; None where the base hardly moves.

    Feet that are flat must not turn, feet that stand together keep what lies between them, and where the base's
    position is known, each stays where it is.
    """
    feet = [c for c in contacts if c.frame in log.contact_names and c.frame in robot.links]
    if log.base_quat_xyzw is None or log.contact_active is None or set(log.joint_names) != set(robot.joint_names):
        return None
    poses = link_poses(log, robot)
    active = {c.frame: log.contact_active[:, log.contact_names.index(c.frame)] for c in feet}
    moved: list[tuple[float, float, int]] = []
    for i, foot in enumerate(feet):
        T = poses[foot.frame].numpy()
        if foot.kind == "flat":
            for axis in range(3):
                moved += _motion(log, T[:, :3, axis], active[foot.frame], 1.0)
        if log.base_position_world is not None:
            moved += _motion(log, T[:, :3, 3], active[foot.frame], _LENGTH, log.base_position_world)
        for other in feet[i + 1 :]:
            between = T[:, :3, 3] - poses[other.frame].numpy()[:, :3, 3]
            moved += _motion(log, between, active[foot.frame] & active[other.frame], _LENGTH)
    world, base, samples = np.array(moved).reshape(-1, 3).sum(axis=0) if moved else (0.0, 0.0, 0)
    if not samples or base / samples < _STILL**2:
        return None
    return float(np.sqrt(world / base))


def _motion(
    log: Log, vector: FloatArray, active: np.ndarray, unit: float, origin: FloatArray | None = None
) -> list[tuple[float, float, int]]:
    """Squares of what a vector of the base moves by within each stance, in the world and in the base; samples."""
    step = median_step(log)
    ends, shortest = round(_ENDS / step), max(4, round(_SHORTEST / step))
    quat = log.base_quat_xyzw
    out = []
    for span in find_spans(active) if quat is not None else ():
        here = slice(span.first + ends, span.last + 1 - ends)
        if quat is None or here.stop - here.start < shortest:
            continue
        world = rotate_to_world(quat[here], vector[here]) + (0.0 if origin is None else origin[here])
        seen, known = (np.square((x - x.mean(axis=0)) / unit).sum() for x in (world, vector[here]))
        out.append((float(seen), float(known), here.stop - here.start))
    return out


# ---------------------------------------------------------------------------------------------- limb sensors in the air

#: Samples in the air that it takes.
_FEW_IN_AIR = 20
#: Correlation above which the weight beyond a sensor is not confounded with its offset: the limb must turn in gravity.
_CLEAR = 0.9
_LIMB_SENSORS = "limb sensors in the air"


def check_limb_sensors(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about the forces that limb sensors read in the air; `cutoff_hz` as in `check_forces_against_urdf`."""
    if robot is None or log.ft_wrench is None:
        return
    try:
        parts = bind_some_samples(
            preprocess_pieces(log, cutoff_hz or default_cutoff_hz(log)), robot, contacts, 4 * COMPARED
        )
    except InputError:  # reported by `check_forces_against_urdf`
        return
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names)))
    series = [force_series(builder, part, robot.nominal.flatten()[None]) for part in parts]
    active = np.concatenate([part.active.numpy() for part in parts])
    for number, name in enumerate(robot.ft_names):
        if name not in log.ft_names:
            continue
        force = slice(robot.base_rows + robot.n + 6 * number, robot.base_rows + robot.n + 6 * number + 3)
        read, carried = (np.concatenate([s[i][..., force].reshape(-1, 3) for s in series]) for i in (0, 1))
        beyond = _contacts_beyond(robot, contacts, name)
        air = ~active[:, beyond].any(axis=1) & np.isfinite(read).all(axis=1)
        if not beyond and not robot.fixed_base and not contacts:
            yield Skipped(_LIMB_SENSORS, "no contacts, of which one might be beyond a sensor")
        elif air.sum() < _FEW_IN_AIR:
            yield Skipped(_LIMB_SENSORS, f"{name}: no readings throughout while nothing beyond it touches")
        else:
            yield from _judged(name, read[air], carried[air], robot)


def _contacts_beyond(robot: Robot, contacts: Sequence[Contact], name: str) -> list[int]:
    """Numbers of the contacts on bodies that hang on a sensor."""

    def hangs(body: int) -> bool:
        joint = robot.bodies[body].joint
        return joint is not None and (joint.name == name or hangs(robot.bodies[body].parent))

    return [number for number, contact in enumerate(contacts) if hangs(robot.links[contact.frame][0])]


def _judged(name: str, read: FloatArray, carried: FloatArray, robot: Robot) -> Iterator[Finding]:
    """Findings about forces (M, 3) that a sensor reads where the URDF's bodies need `carried`, (M, 3)."""
    weight = float(np.linalg.norm(carried.mean(axis=0)))
    varying, moving = carried - carried.mean(axis=0), read - read.mean(axis=0)
    product = float((varying * moving).sum())
    clear = abs(product) > _CLEAR * np.linalg.norm(varying) * np.linalg.norm(moving)
    share = product / float(np.square(varying).sum()) if clear else 1.0
    told = f"{name}: in the air it reads {share:.3g} times what hangs on it by the URDF ({weight:.3g} N)"
    if share < 0.0:
        advice = "reverse it: the wrench that the parent side exerts on the child side"
        yield Finding("sign", CONDEMNED, "ft_wrench", told, advice, (name,))
        return
    if abs(share - 1.0) > WRONG_MASS:
        advice = "look at the sensor's unit and gain, and at what is mounted beyond it"
        yield Finding("weight", SUSPICIOUS, "ft_wrench", told, advice, (name,))
    left = read - share * carried
    offset = np.median(left, axis=0)
    size, spread = float(np.linalg.norm(offset)), NORMAL * float(np.median(np.linalg.norm(left - offset, axis=1)))
    known = UNLOADED * GRAVITY * float(robot.nominal[:, 0].sum()) + (0.0 if clear else WRONG_MASS * weight)
    if size > max(known, spread):
        text = f"{name}: reads a steady {size:.3g} N in the air beside the {weight:.3g} N that hang on it by the URDF"
        mixed = "" if clear else "; a load of that weight would look the same"
        advice = f"identify it, sensors.offsets: {{ft_force: log}}, or subtract it{mixed}"
        yield Finding("offset", NOTE, "ft_wrench", text, advice, (name,))
