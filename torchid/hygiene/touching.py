"""Contact flags against the forces of the same contacts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from torchid.hygiene.channels import median_step
from torchid.hygiene.finding import CONDEMNED, NOTE, SUSPICIOUS, Finding, Skipped, Span, spans_of
from torchid.hygiene.neighbours import NORMAL
from torchid.logs import Log
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray
from torchid.text import counted

#: Share of the weight that an inactive contact must not carry. Thresholds of flags are 20 to 50 N, for 60 kg 3 to 8 %.
LOADED = 0.1
#: Share of the weight below which an active contact carries nothing.
UNLOADED = 0.005
#: Seconds for which a contact may be active without a force: a filter widens flags by as much.
_PATIENCE = 0.1
#: Share of an offset in the air that may vary for it to be one, samples that it takes, and the share of the usual load
#: from which on it is no offset but a foot that stands.
_STEADY, _FEW, _OF_LOAD = 0.2, 10, 0.5
#: Samples between the change of a flag and that of the force, and over how many seconds to look for the latter.
LATE, _SEARCH = 2, 0.2
#: Changes it takes to speak of a delay, and share of them that must agree to a sample or two.
_FEWEST, _AGREE = 3, 0.7
_NAME = "contact flags against forces"


@dataclass(frozen=True, eq=False)
class _Contact:
    name: str
    active: BoolArray
    force: FloatArray  # (N, 3) [N], NaN where it was not read


def touching(log: Log) -> Iterator[Finding | Skipped]:
    """Findings about contacts, by what they carry together: forces may be in any unit."""
    if not log.contact_names:
        return
    contacts = list(_contacts(log))
    if not contacts:
        yield Skipped(_NAME, "no contact whose force was measured whenever it touches")
        return
    judged = {contact.name for contact in contacts}
    for name in (name for name in log.contact_names if name not in judged):
        yield Skipped(_NAME, f"{name}: its force was not measured whenever it touches")
    weight = _largest_load(contacts)
    if not weight > 0.0:
        yield Skipped(_NAME, "all contact forces are zero")
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
    wrench = log.contact_wrench_local if log.contact_wrench_world is None else log.contact_wrench_world
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


def without_offsets(log: Log) -> Log:
    """The log with what contact sensors read steadily in the air taken off."""
    offsets = {contact.name: _offset(contact) for contact in _contacts(log)}
    field = WRENCHES[0] if log.contact_wrench_world is None else WRENCHES[1]
    if not any(np.any(offset) for offset in offsets.values()):
        return log
    wrench = getattr(log, field).copy()
    for name, offset in offsets.items():
        wrench[:, log.contact_names.index(name), :3] -= offset
    return dataclasses.replace(log, **{field: wrench})


def _offset(contact: _Contact) -> FloatArray:
    """What the sensor reads steadily in the air, (3,) [N]; 0 where it does not."""
    air = contact.force[~contact.active & np.isfinite(contact.force[:, 0])]
    if len(air) < _FEW or not contact.active.any():
        return np.zeros(3)
    offset = np.median(air, axis=0)
    spread = NORMAL * float(np.median(np.linalg.norm(air - offset, axis=1)))
    size, load = float(np.linalg.norm(offset)), float(np.median(np.linalg.norm(contact.force[contact.active], axis=1)))
    return offset if spread < _STEADY * size and size < _OF_LOAD * load else np.zeros(3)


def _contradictions(log: Log, contact: _Contact, size: FloatArray, weight: float) -> Iterator[Finding]:
    """Forces without a contact, and contacts without a force."""
    loaded = ~contact.active & (size > LOADED * weight)
    if loaded.any():
        samples = counted(int(loaded.sum()), "sample")
        text = f"{contact.name}: inactive with up to {size[loaded].max():.3g} N, in {samples}"
        advice = "set the flag where there is a force: what an inactive contact exerts is not counted"
        spans = tuple(spans_of(loaded, contact.name))
        yield Finding("force without contact", CONDEMNED, "contact_active", text, advice, (contact.name,), spans)
    patience = max(1, round(_PATIENCE / median_step(log)))
    light = contact.active & (size < UNLOADED * weight)
    spans = tuple(span for span in spans_of(light, contact.name) if len(span) > patience)
    if spans:
        samples = counted(sum(len(span) for span in spans), "sample")
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
