"""Whether anything moves in logs: forces at rest tell what balances gravity, no inertia and no friction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from torchid.parameters import GRAVITY
from torchid.problem.samples import Samples

MIN_MOTION = 0.01
"""Travel [rad or m] up to which a joint stands still."""
MIN_TURN_DEG = 1.0
"""Turn [degrees] from which on a base moves."""
_MIN_ACCELERATION = 0.1 * GRAVITY  # [m/s^2] rms, of a base that is shaken; noise of a pose in half a millimetre: 0.4
_MOST_SAMPLES = 5_000  # evenly spaced


def is_at_rest(logs: Sequence[Samples]) -> bool:
    """Whether in none of some logs a joint or the base moves; not so without any log."""
    return bool(logs) and not any(_moves(log) for log in logs)


def _moves(log: Samples) -> bool:
    """Whether a joint of a filtered log travels, or its base turns or is shaken."""
    thin = log.every(max(1, len(log) // _MOST_SAMPLES))
    position, base = thin.joint_position, thin.base
    if position.shape[1] and float((position.amax(dim=0) - position.amin(dim=0)).max()) > MIN_MOTION:
        return True
    if base.quat_xyzw is not None:
        cosine = (base.quat_xyzw @ base.quat_xyzw[0]).abs().clamp(max=1.0)
        if float(2.0 * torch.arccos(cosine).max()) > math.radians(MIN_TURN_DEG):
            return True
    force = base.specific_force
    if force is None:
        return False
    return float((force - force.mean(dim=0)).square().sum(dim=1).mean().sqrt()) > _MIN_ACCELERATION
