"""What the robot is to do: sine waves of its centre of mass, base and joints, and feet lifted in turn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.config import MotionConfig, StepsConfig
from torchid.errors import InputError, UnknownNameError
from torchid.logs.log import BoolArray
from torchid.parameters import Array
from torchid.simulation.controller import ALOFT, Goal, Stance

BODY = ("com_x", "com_y", "com_z", "base_roll", "base_pitch", "base_yaw")  # what waves move, besides joints
LEAD_S = 2.0  # waves grow to their amplitude in this time, before the log begins


class ReferenceMotion:
    """A motion of a robot that starts from a stance: a goal for every control step from -LEAD_S to its end.

    Args:
        config: waves and steps.
        stance: where it starts.
        joint_names: of the robot, in the plant's order.
        feet: frames of the feet.
        control_hz: control rate [Hz].
        source: named in errors.

    Raises:
        UnknownNameError: a wave moves something that the robot does not have.
        InputError: it is too short, or faster than can be controlled.
    """

    def __init__(
        self,
        config: MotionConfig,
        stance: Stance,
        joint_names: Sequence[str],
        feet: Sequence[str],
        control_hz: float,
        source: object,
    ) -> None:
        self.name = config.name
        self._stance = stance
        names = (*BODY, *joint_names)
        if config.duration_s * control_hz < 2.0:
            found, wanted = f"{config.duration_s:g}", f"at least two control steps, {2.0 / control_hz:g} s"
            raise InputError(source, f"motions.{config.name}.duration_s", found, wanted)
        steps = round((LEAD_S + config.duration_s) * control_hz)
        self.time = np.arange(steps) / control_hz - LEAD_S
        grown = _smooth((self.time + LEAD_S) / LEAD_S)
        moved = np.zeros((steps, len(names)))
        for index, wave in enumerate(config.waves):
            if wave.what not in names:
                raise UnknownNameError(source, f"motions.{config.name}.waves.{index}.what", wave.what, names)
            if wave.hz >= 0.5 * control_hz:
                accepted = f"below {0.5 * control_hz:g}, half of control_hz"
                raise InputError(source, f"motions.{config.name}.waves.{index}.hz", f"{wave.hz:g}", accepted)
            sine = np.sin(2.0 * np.pi * (wave.hz * self.time + wave.phase))
            moved[:, names.index(wave.what)] += wave.amplitude * grown * sine
        self._moved = _with_derivatives(moved, control_hz)
        self._driven = np.array([any(wave.what == name for wave in config.waves) for name in joint_names])
        if config.steps and config.steps.swing_s + 2.0 * config.steps.transfer_s > 1.0 / config.steps.hz:
            found = f"{config.steps.swing_s:g} in the air and twice {config.steps.transfer_s:g} to transfer the load"
            accepted = f"at most the period of {1.0 / config.steps.hz:g} s together"
            raise InputError(source, f"motions.{config.name}.steps.swing_s", found, accepted)
        for frame in config.steps.order if config.steps else ():
            if frame not in feet:
                raise UnknownNameError(source, f"motions.{config.name}.steps.order", frame, feet)
        height, self._load = _steps(config.steps, feet, self.time)
        self._lift = _with_derivatives(height, control_hz)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def supports(self) -> BoolArray:
        """The sets of feet, (S, F), that carry the robot at one time or another."""
        return np.unique(self._load > ALOFT, axis=0)

    def __iter__(self) -> Iterator[Goal]:
        """The goals, one per control step."""
        stance = self._stance
        n = self._moved.shape[2] - len(BODY)
        rest = np.zeros((3, 3 + n))
        rest[0] = [*stance.com, *stance.position[7:]]
        feet = np.zeros((len(stance.feet), 3, 3))
        feet[:, 0] = stance.feet
        turns = Rotation.from_rotvec(self._moved[0, :, 3:6]).as_matrix()
        for i in range(len(self)):
            moved = self._moved[:, i]
            lifted = feet.copy()
            lifted[:, :, 2] += self._lift[:, i].T
            yield Goal(
                com=rest[:, :3] + moved[:, :3],
                base=turns[i],
                base_rate=moved[1:, 3:6],
                joints=rest[:, 3:] + moved[:, 6:],
                driven=self._driven,
                feet=lifted,
                load=self._load[i],
            )


def _steps(steps: StepsConfig | None, feet: Sequence[str], time: Array) -> tuple[Array, Array]:
    """Height (T, F) [m] and share of the load (T, F) of every foot, lifted in turn from time 0 on."""
    height, load = np.zeros((len(time), len(feet))), np.ones((len(time), len(feet)))
    if steps is None:
        return height, load
    for turn, frame in enumerate(steps.order):
        foot = feet.index(frame)
        middle = (turn + 0.5) / len(steps.order)
        off = ((time * steps.hz - middle + 0.5) % 1.0 - 0.5) / steps.hz  # s from the middle of the swing
        inside = 1.0 - np.abs(off) / (0.5 * steps.swing_s)
        stepping = time - off > 0.5 * steps.swing_s + steps.transfer_s  # not if it had to begin before time 0
        height[:, foot] += np.where(stepping & (inside > 0.0), steps.height_m * _bump(inside), 0.0)
        unloaded = (np.abs(off) - 0.5 * steps.swing_s) / steps.transfer_s
        load[:, foot] = np.minimum(load[:, foot], np.where(stepping, _smooth(unloaded), 1.0))
    return height, load


def _with_derivatives(x: Array, hz: float) -> Array:
    """`x`, (T, ...), and its first two derivatives, (3, T, ...)."""
    rate = np.gradient(x, 1.0 / hz, axis=0)
    return np.stack([x, rate, np.gradient(rate, 1.0 / hz, axis=0)])


def _smooth(u: Array) -> Array:
    """From 0 (u <= 0) to 1 (u >= 1) with two continuous derivatives."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def _bump(u: Array) -> Array:
    """1 in the middle of a swing (u = 1), 0 at its ends (u = 0), where it starts with a strong acceleration."""
    u = np.clip(u, 0.0, 1.0)
    return u**2 * (2.0 - u) ** 2
