"""Feet that slip: standing by their flags, and moving on the ground in some samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchid.errors import InputError
from torchid.log_checks.findings import SUSPICIOUS, Finding, Skipped, find_spans
from torchid.log_checks.model import MAX_DIFFERENTIATED_SAMPLES, default_cutoff_hz, preprocess_pieces
from torchid.logs import Log
from torchid.problem import bind_log
from torchid.problem.contact_slip import measure_slip
from torchid.robot import Robot
from torchid.sensing import Contact

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
