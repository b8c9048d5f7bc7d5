"""In which frame the recorded velocities of a base are: by the slope of its position and orientation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from torchid.logs.log import FloatArray
from torchid.logs.proposed_map import MapProposal
from torchid.logs.quaternion import angular_velocity_base, make_sign_continuous, rotate_to_base, rotate_to_world
from torchid.logs.units import quantities_of, unit_factor

_AVERAGED = 0.1  # [s]: over which velocities are compared, for the noise of slopes
_LIKE, _CLEAR = 0.5, 0.8  # error of a velocity that is the slope, and of one frame in the other's, at most
_FRAMES = ("world", "base")


def settle_velocities(proposal: MapProposal, values: Callable[[str], FloatArray | None], seconds: FloatArray) -> None:
    """Give the velocities of a base in a proposed map the frame that they are in.

    Those that are the slope of its pose in no frame are left out: the pose alone gives velocities.

    Args:
        proposal: changed in place.
        values: numbers (N, k) of an entry, as the file has them.
        seconds: the stamps (N,).
    """
    columns, notes = proposal.columns, proposal.notes
    step = float(np.median(np.diff(seconds)))
    width = max(1, round(_AVERAGED / step)) if step > 0.0 else 1
    for kind, slopes in _slopes(columns, values, seconds).items():
        for name in [x for frame in slopes if (x := f"base_{kind}_velocity_{frame}") in columns]:
            recorded = _in_si(name, columns, values)
            if recorded is None or recorded.shape != slopes["world"].shape:
                continue
            errors = {frame: _error(recorded, slope, width) for frame, slope in slopes.items()}
            best, other = sorted(errors, key=lambda frame: errors[frame])
            if errors[best] > _LIKE:
                notes[name] = "left out, as it is the slope of the base's pose along no axes"
                proposal.leave_out(name)
            elif errors[best] < _CLEAR * errors[other]:
                _rename(columns, notes, name, f"base_{kind}_velocity_{best}", f"along the axes of the {best}")


def _rename(columns: dict[str, Any], notes: dict[str, str], old: str, new: str, why: str) -> None:
    """Another key of an entry, in its place."""
    if old != new:
        entries = [(new if key == old else key, entry) for key, entry in columns.items() if key != new]
        columns.clear()
        columns.update(entries)
        notes[new] = "; ".join(filter(None, (notes.pop(old, ""), f"{why}, by the slope of the base's pose")))


def _in_si(name: str, columns: dict[str, Any], values: Callable[[str], FloatArray | None]) -> FloatArray | None:
    found, entry = values(name), columns.get(name, {})
    if found is None or isinstance(entry.get("unit"), dict):
        return None
    return found * (unit_factor(name, entry["unit"], quantities_of(name)) if "unit" in entry else 1.0)


def _slopes(
    columns: dict[str, Any], values: Callable[[str], FloatArray | None], seconds: FloatArray
) -> dict[str, dict[str, FloatArray]]:
    """Linear and angular velocity (N, 3) [m/s, rad/s] along each axes, as far as a pose gives them."""
    quat = values("base_quat_xyzw")
    if quat is None and (wxyz := values("base_quat_wxyz")) is not None and wxyz.shape[1] == 4:
        quat = np.roll(wxyz, -1, axis=1)
    if quat is None or quat.shape != (len(seconds), 4) or len(seconds) < 3 or not (np.diff(seconds) > 0.0).all():
        return {}
    quat = make_sign_continuous(quat)
    rate = angular_velocity_base(quat, np.gradient(quat, seconds, axis=0))
    out = {"angular": {"world": rotate_to_world(quat, rate), "base": rate}}
    position = _in_si("base_position_world", columns, values)
    if position is not None and position.shape == (len(seconds), 3):
        slope = np.gradient(position, seconds, axis=0)
        out["linear"] = {"world": slope, "base": rotate_to_base(quat, slope)}
    return out


def _error(recorded: FloatArray, slope: FloatArray, width: int) -> float:
    """Relative rms error of recorded velocities, both averaged over some samples."""
    box = np.full(width, 1.0 / width)
    both = (recorded, slope)
    a, b = (np.stack([np.convolve(x, box, "valid") for x in of.T], axis=1) for of in both)
    return float(np.sqrt(np.nanmean((a - b) ** 2) / max(float(np.nanmean(b**2)), 1e-12)))
