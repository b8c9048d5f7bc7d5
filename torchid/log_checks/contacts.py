"""Contact flags against forces, slip, wrenches of scalar sensors, and sensors in limbs without contact."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.errors import InputError, format_count
from torchid.log_checks.findings import (
    NOTE,
    REJECTED,
    SUSPICIOUS,
    Finding,
    Skipped,
    Span,
    find_spans,
    median_step,
)
from torchid.log_checks.mistakes import quarter_turns
from torchid.log_checks.model import (
    COMPARED_SAMPLES,
    MAX_DIFFERENTIATED_SAMPLES,
    bind_some_samples,
    default_cutoff_hz,
    preprocess_pieces,
)
from torchid.log_checks.weight import MAX_MASS_ERROR
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, BoolArray, FloatArray
from torchid.parameters import GRAVITY, WRENCH_COMPONENTS
from torchid.problem import RowBuilder, bind_log
from torchid.problem.contact_slip import measure_slip
from torchid.problem.predict import force_series
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD
from torchid.sensing import Contact, named_sensors

# ------------------------------------------------------------------------------------------------- flags against forces

#: Share of the weight that an inactive contact may carry. Thresholds of flags are 20 to 50 N, for 60 kg 3 to 8 %.
MAX_INACTIVE_WEIGHT_SHARE = 0.1
#: Share of the weight that an active contact carries at least.
MIN_ACTIVE_WEIGHT_SHARE = 0.005
#: The same of all contacts together, from which on a robot stands though no flag says so.
_MIN_STANDING_WEIGHT_SHARE = 0.5
#: Time for which a contact may be active without a force: filters widen flags by as much.
_MAX_UNLOADED_S = 0.1
#: A reading in the air is an offset if it varies by at most this share, has enough samples, and is below this share of
#: the usual load: above it, the foot stands.
_MAX_OFFSET_SPREAD_SHARE, _MIN_OFFSET_SAMPLES, _MAX_OFFSET_LOAD_SHARE = 0.2, 10, 0.5
#: Share of its active samples in which a sensor reads other than 0 up to which it is dead: noise alone is not 0.
_MOST_READ_OF_DEAD_SHARE = 0.01
#: Delay of a flag against the force: its resolution, and the longest one.
MIN_DELAY_SAMPLES, _MAX_DELAY_S = 2, 0.2
#: Changes of a flag that a delay needs, and the share of them that must agree to `MIN_DELAY_SAMPLES`.
_MIN_CHANGES, _MIN_AGREEING_SHARE = 3, 0.7
_FLAG_CHECK = "contact flags against forces"


@dataclass(frozen=True, eq=False)
class _Contact:
    name: str
    active: BoolArray
    force: FloatArray  # (N, 3) [N], NaN where not measured


def check_contact_flags(log: Log, robot: Robot | None = None) -> Iterator[Finding | Skipped]:
    """Findings about contact flags and sensor offsets, relative to the total load: forces may be in any unit.

    Where no flag ever lets a contact carry, forces tell a robot that stands from one in the air by the URDF's weight.
    """
    if not log.contact_names:
        return
    contacts = list(_contacts(log))
    if not contacts:
        yield Skipped(_FLAG_CHECK, "no contact whose force was measured whenever it touches")
        return
    judged = {contact.name for contact in contacts}
    for name in (name for name in log.contact_names if name not in judged):
        yield Skipped(_FLAG_CHECK, f"{name}: its force was not measured whenever it touches")
    weight = _largest_load(contacts) or _load_without_flags(contacts, robot)
    if not weight > 0.0:
        yield Skipped(_FLAG_CHECK, "no contact carries anything while it touches")
        return
    for contact in contacts:
        offset = _offset(contact)
        size = np.linalg.norm(contact.force - offset, axis=1)
        if (constant := float(np.linalg.norm(offset))) > MIN_ACTIVE_WEIGHT_SHARE * weight:
            text = f"{contact.name}: reads a steady {constant:.3g} N in the air"
            advice = "identify it, sensors.offsets: {contact_force: log}, or subtract it, preprocessing.zero_in_air"
            yield Finding("offset", NOTE, "contact_wrench", text, advice, (contact.name,))
        yield from _load_findings(log, contact, size, weight)
        yield from _delay_findings(log, contact, size, weight)


def _contacts(log: Log) -> Iterator[_Contact]:
    """Contacts whose force was measured in all active samples; NaN is allowed while a contact is inactive."""
    wrench = log.contact_wrench
    if wrench is None or log.contact_active is None:
        return
    for index, name in enumerate(log.contact_names):
        force, active = wrench[:, index, :3], log.contact_active[:, index]
        measured = np.asarray(np.isfinite(force).all(axis=1))
        if measured.any() and measured[active].all():
            yield _Contact(name, active, np.where(measured[:, None], force, np.nan))


def _largest_load(contacts: list[_Contact]) -> float:
    """High percentile of the total contact force [N]: about the weight of a standing robot."""
    sizes = [np.where(contact.active, np.linalg.norm(contact.force, axis=1), 0.0) for contact in contacts]
    total = np.sum(sizes, axis=0)
    return float(np.percentile(total, 90.0))


def _load_without_flags(contacts: list[_Contact], robot: Robot | None) -> float:
    """Median total contact force [N] whatever the flags say; 0 where it is far from carrying the robot."""
    if robot is None:
        return 0.0
    total = np.sum([np.nan_to_num(np.linalg.norm(contact.force, axis=1)) for contact in contacts], axis=0)
    load = float(np.median(total))
    return load if load > _MIN_STANDING_WEIGHT_SHARE * GRAVITY * float(robot.nominal[:, 0].sum()) else 0.0


def subtract_contact_offsets(log: Log) -> Log:
    """The log without the constant readings of contact sensors in the air."""
    offsets = {contact.name: _offset(contact) for contact in _contacts(log)}
    field = log.contact_wrench_field
    if not any(np.any(offset) for offset in offsets.values()):
        return log
    wrench = getattr(log, field).copy()
    for name, offset in offsets.items():
        wrench[:, log.contact_names.index(name), :3] -= offset
    return dataclasses.replace(log, **{field: wrench})


def _offset(contact: _Contact) -> FloatArray:
    """The sensor's constant reading in the air, (3,) [N]; 0 where it has none."""
    air = contact.force[~contact.active & np.isfinite(contact.force[:, 0])]
    if len(air) < _MIN_OFFSET_SAMPLES or not contact.active.any():
        return np.zeros(3)
    offset = np.median(air, axis=0)
    size, load = float(np.linalg.norm(offset)), float(np.median(np.linalg.norm(contact.force[contact.active], axis=1)))
    constant = _spread(air - offset) < _MAX_OFFSET_SPREAD_SHARE * size
    return offset if constant and size < _MAX_OFFSET_LOAD_SHARE * load else np.zeros(3)


def _spread(deviations: FloatArray) -> float:
    """Robust standard deviation of vectors (M, 3) about their median."""
    return STD_PER_MAD * float(np.median(np.linalg.norm(deviations, axis=1)))


def _load_findings(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Findings about forces without a contact, and contacts without a force."""
    loaded = ~contact.active & (size > MAX_INACTIVE_WEIGHT_SHARE * weight)
    if loaded.any():
        samples = format_count(int(loaded.sum()), "sample")
        text = f"{contact.name}: inactive with up to {size[loaded].max():.3g} N, in {samples}"
        advice = "set the flag where there is a force: forces of inactive contacts are ignored"
        spans = tuple(find_spans(loaded, contact.name))
        yield Finding("force without contact", REJECTED, "contact_active", text, advice, (contact.name,), spans)
    longest = max(1, round(_MAX_UNLOADED_S / median_step(log)))
    threshold = MIN_ACTIVE_WEIGHT_SHARE * weight
    unloaded = contact.active & (size < threshold)
    spans = tuple(span for span in find_spans(unloaded, contact.name) if len(span) > longest)
    if spans:
        samples = format_count(sum(len(span) for span in spans), "sample")
        never = " though the flag never changes" if contact.active.all() else ""
        text = f"{contact.name}: active without a force (below {threshold:.2g} N) in {samples}{never}"
        advice = "clear the flag where the foot is in the air: it removes data, but causes no error"
        if np.mean(contact.force[contact.active].any(axis=1)) < _MOST_READ_OF_DEAD_SHARE:
            text = f"{contact.name}: its sensor reads 0 in {samples} in which it is active: dead, or of another column"
            advice = "leave it out: name the others in sensors.contact_wrenches; or mend the column or flags in the air"
        yield Finding("contact without force", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


def _delay_findings(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Findings about flags that change earlier or later than the force."""
    touches = size > 0.5 * MAX_INACTIVE_WEIGHT_SHARE * weight
    flags, forces = (np.flatnonzero(np.diff(x.astype(np.int8))) for x in (contact.active, touches))
    if len(flags) < _MIN_CHANGES or len(forces) < _MIN_CHANGES or len(log) < 3:
        return
    longest = max(MIN_DELAY_SAMPLES + 1, round(_MAX_DELAY_S / median_step(log)))
    shifts: dict[bool, list[int]] = {True: [], False: []}  # by direction: landing, lift-off
    for flag, landing in zip(flags, contact.active[flags + 1], strict=True):
        candidates = forces[touches[forces + 1] == landing]
        nearest = candidates[np.argmin(np.abs(candidates - flag))] if len(candidates) else flag + longest + 1
        if abs(nearest - flag) <= longest:
            shifts[bool(landing)].append(int(flag - nearest))
    count = sum(map(len, shifts.values()))
    if count < _MIN_CHANGES:
        return
    typical = {landing: float(np.median(values or [0])) for landing, values in shifts.items()}
    agree = [abs(x - typical[landing]) <= MIN_DELAY_SAMPLES for landing, values in shifts.items() for x in values]
    same_direction = typical[True] * typical[False] > 0.0
    late_enough = min(map(abs, typical.values())) >= MIN_DELAY_SAMPLES
    if np.mean(agree) < _MIN_AGREEING_SHARE or not same_direction or not late_enough:
        return
    shift = float(np.mean(list(typical.values())))
    text = f"{contact.name}: the flag changes {abs(shift):.3g} samples {'after' if shift > 0 else 'before'} the force"
    spans = tuple(Span(int(i), int(i) + 1, contact.name) for i in flags)
    advice = "shift contact_active, or derive it from the forces"
    yield Finding("delay", SUSPICIOUS, "contact_active", text, advice, (contact.name,), spans)


def check_scalar_wrenches(log: Log) -> Iterator[Finding]:
    """Findings about wrenches of which one force alone is ever other than 0: a scalar sensor's reading among zeros."""
    wrench, active = log.contact_wrench, log.contact_active
    if wrench is None or active is None:
        return
    for index, name in enumerate(log.contact_names):
        touching = wrench[active[:, index], index]
        present = np.nan_to_num(touching).any(axis=0)
        forces = np.flatnonzero(present[:3])
        if len(forces) != 1 or present[3:].any() or np.isnan(touching[:, :3]).any():
            continue
        text = f"{name}: all but {WRENCH_COMPONENTS[forces[0]]} is 0 throughout, as of a scalar sensor"
        advice = (
            f"give it as {FORCE_NORMAL}, with sensors.contact_wrenches: {{FRAME: [fn]}}: zeros are fitted as measured "
            "forces along the frame's axes"
        )
        yield Finding("scalar sensor", SUSPICIOUS, log.contact_wrench_field, text, advice, (name,))


# -------------------------------------------------------------------------------------------------------------- slip

MOST_SLIPPING_SHARE = 0.3
"""Of a contact's samples: where more of them slip it is no slip, but wrong flags, radii or another motion."""

CLEAR_SLIP = 2.0
"""Times its limit that a contact that is named moves at its fastest: noise of cameras and encoders has long tails."""

_SLIP_CHECK = "slip of contacts"
_ADVICE = "preprocessing.max_slip: auto leaves these samples out; look for dust, a soft floor or flags that are late"


def check_slip(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None, derived: tuple[str, ...] = ()
) -> Iterator[Finding | Skipped]:
    """Findings about contacts that slip; none on flags, or with a base's motion, that torchid made."""
    if robot is None or not contacts or log.contact_active is None:
        return
    if derived:
        return
    cutoff_hz = cutoff_hz or default_cutoff_hz(log)
    slips, checked = np.zeros((len(log), len(contacts)), dtype=bool), False
    standing, fastest = np.zeros(len(contacts)), np.zeros(len(contacts))
    for start in range(0, len(log), MAX_DIFFERENTIATED_SAMPLES):
        part = log.select(slice(start, start + MAX_DIFFERENTIATED_SAMPLES))
        try:
            (ready,) = preprocess_pieces(part, cutoff_hz)
            samples = bind_log(ready, robot, contacts)
        except InputError as error:
            yield Skipped(_SLIP_CHECK, f"{error.field}: {error.found}")
            return
        slip = measure_slip(ready, samples, part, robot, contacts, cutoff_hz=cutoff_hz)
        checked |= slip.checked
        nearest = start + np.searchsorted(part.time, ready.time).clip(0, len(part) - 1)
        for index in range(len(contacts)):
            slips[nearest[slip.slips[:, index]], index] = True
        standing += np.isfinite(slip.speed).sum(axis=0)
        fastest = np.maximum(fastest, np.nanmax(slip.speed / slip.limits, axis=0, initial=0.0))
    if not checked:
        yield Skipped(_SLIP_CHECK, "neither the base's linear velocity nor two contacts that stand at once")
    for contact, own, stands, peak in zip(contacts, slips.T, standing.tolist(), fastest.tolist(), strict=True):
        if peak >= CLEAR_SLIP and own.sum() <= MOST_SLIPPING_SHARE * stands:
            text = f"{contact.frame} moves on the ground in {int(own.sum())} samples"
            yield Finding("slip", SUSPICIOUS, "contact_active", text, _ADVICE, (contact.frame,), tuple(find_spans(own)))


# ---------------------------------------------------------------------------------------------- limb sensors in the air

#: Samples in the air that the check needs.
_MIN_AIR_SAMPLES = 20
#: Correlation of reading and model that separates the weight beyond a sensor from its offset: the limb must turn.
_MIN_CORRELATION = 0.9
#: Share of the squared residual of another mass beyond a sensor that mass and offset may leave, for the offset to be
#: told from a mass: noise of accelerations makes the mass too small and an offset of the rest, which leave 0.85 of it.
_MAX_OFFSET_RESIDUAL = 0.5
#: Misfit of a sensor's forces that loads and offsets do not make, and the share of it that another frame may leave.
_MIN_FRAME_MISFIT, _MAX_TURNED_SHARE = 0.7, 0.35
_LIMB_SENSOR_CHECK = "limb sensors in the air"


def check_limb_sensors(
    log: Log, robot: Robot | None, contacts: Sequence[Contact], cutoff_hz: float | None
) -> Iterator[Finding | Skipped]:
    """Findings about the forces that limb sensors read in the air; `cutoff_hz` as in `check_forces_against_urdf`."""
    if robot is None or log.ft_wrench is None:
        return
    try:
        pieces = preprocess_pieces(log, cutoff_hz or default_cutoff_hz(log))
        parts = bind_some_samples(pieces, robot, contacts, 4 * COMPARED_SAMPLES)
    except InputError:  # reported by `check_forces_against_urdf`
        return
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names)))
    series = [force_series(builder, part, robot.nominal.flatten()[None]) for part in parts]
    active = np.concatenate([part.active.numpy() for part in parts])
    for number, name in enumerate(robot.ft_names):
        if name not in log.ft_names:
            continue
        force = slice(robot.base_rows + robot.n + 6 * number, robot.base_rows + robot.n + 6 * number + 3)
        measured, model = (np.concatenate([s[i][..., force].reshape(-1, 3) for s in series]) for i in (0, 1))
        beyond = _contacts_beyond(robot, contacts, name)
        air = ~active[:, beyond].any(axis=1) & np.isfinite(measured).all(axis=1)
        if not beyond and not robot.fixed_base and not contacts:
            yield Skipped(_LIMB_SENSOR_CHECK, "no contacts, of which one might be beyond a sensor")
        elif air.sum() < _MIN_AIR_SAMPLES:
            yield Skipped(_LIMB_SENSOR_CHECK, f"{name}: no readings throughout while nothing beyond it touches")
        else:
            yield from _limb_sensor_findings(name, measured[air], model[air], robot)


def _contacts_beyond(robot: Robot, contacts: Sequence[Contact], name: str) -> list[int]:
    """Numbers of the contacts on bodies beyond a sensor."""
    above = ([robot.bodies[x].joint for x in robot.bodies_to(robot.links[contact.frame][0])] for contact in contacts)
    return [number for number, joints in enumerate(above) if any(x is not None and x.name == name for x in joints)]


def _turned_sensor(measured: FloatArray, model: FloatArray) -> str | None:
    """The quarter turn that makes measured forces (M, 3) those of the model, in words, if they are not without one."""

    def misfit(forces: FloatArray) -> float:
        return float(np.linalg.norm(forces - model)) / max(float(np.linalg.norm(model)), 1e-9)

    as_read = misfit(measured)
    left, words = min((misfit(measured @ R.T), words) for words, R in quarter_turns())
    return words if as_read > _MIN_FRAME_MISFIT and left < _MAX_TURNED_SHARE * as_read else None


def _limb_sensor_findings(name: str, measured: FloatArray, model: FloatArray, robot: Robot) -> Iterator[Finding]:
    """Findings about measured forces (M, 3) of a sensor against those of the URDF's bodies, (M, 3)."""
    weight = float(np.linalg.norm(model.mean(axis=0)))
    x, y = model - model.mean(axis=0), measured - measured.mean(axis=0)
    product = float((x * y).sum())
    correlated = abs(product) > _MIN_CORRELATION * np.linalg.norm(x) * np.linalg.norm(y)
    if not correlated and (turned := _turned_sensor(measured, model)) is not None:
        text = f"{name}: in the air it reads what hangs on it by the {robot.format} along axes turned by right angles"
        advice = f"turn forces and moments into the joint's child frame, whose {turned}"
        yield Finding("frame", SUSPICIOUS, "ft_wrench", text, advice, (name,))
        return
    gain = product / float(np.square(x).sum()) if correlated else 1.0
    text = f"{name}: in the air it reads {gain:.3g} times what hangs on it by the {robot.format} ({weight:.3g} N)"
    if gain < 0.0:
        advice = "reverse it: the wrench that the parent side exerts on the child side"
        yield Finding("sign", REJECTED, "ft_wrench", text, advice, (name,))
        return
    if abs(gain - 1.0) > MAX_MASS_ERROR:
        advice = "check the sensor's unit and gain, and the load that is mounted beyond it"
        yield Finding("weight", SUSPICIOUS, "ft_wrench", text, advice, (name,))
    residual = measured - gain * model
    offset = np.median(residual, axis=0)
    size, spread = float(np.linalg.norm(offset)), _spread(residual - offset)
    threshold = MIN_ACTIVE_WEIGHT_SHARE * GRAVITY * float(robot.nominal[:, 0].sum())
    mass_alone = measured - (measured.mean(axis=0) @ model.mean(axis=0)) / max(weight, 1e-9) ** 2 * model
    separate = correlated and np.square(residual - offset).sum() < _MAX_OFFSET_RESIDUAL * np.square(mass_alone).sum()
    if not separate:
        threshold += MAX_MASS_ERROR * weight
    if size > max(threshold, spread):
        hanging = f"the {weight:.3g} N that hang on it by the {robot.format}"
        text = f"{name}: reads a steady {size:.3g} N in the air beside {hanging}"
        ambiguity = "" if separate else "; a load of that weight would look the same"
        advice = f"identify it, sensors.offsets: {{ft_force: log}}, or subtract it{ambiguity}"
        yield Finding("offset", NOTE, "ft_wrench", text, advice, (name,))
