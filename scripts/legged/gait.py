"""A prescribed motion: a base that sways, feet lifted in turn, joints that follow from both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.linalg import solve_banded
from scipy.spatial.transform import Rotation

from legged.robots import Legged, TrueRobot, sphere_radius
from legged.trajectories import BaseMotion, Swing, quintic, waves
from torchid.parameters import Array

_KNOTS_HZ = 50.0
_RAMP = 0.1  # s in which a foot takes its load, and gives it away
_START = 0.8  # s before the first swing
_LOWERED = 0.015  # m: legs keep away from being straight
_ITERATIONS, _REACHED = 20, 1e-9
_GRAVITY = 9.81
_CORRECTIONS = 2  # of the base, to have the centre of mass where it balances


@dataclass(frozen=True)
class Steps:
    """Which feet are in the air when: starts and lengths of swings [s], feet, and strides (K, F, 3) [m]."""

    legged: Legged
    home: Array  # (F, 3) [m]
    swings: Sequence[tuple[float, float, tuple[int, ...]]]
    strides: Array

    @classmethod
    def plan(
        cls, legged: Legged, home: Array, seconds: float, groups: Sequence[tuple[int, ...]], rng: np.random.Generator
    ) -> Steps:
        """Swings of groups of feet in turn, to places around where the feet stood at first."""
        swings: list[tuple[float, float, tuple[int, ...]]] = []
        start, turn = _START, int(rng.integers(max(len(groups), 1)))
        while groups and start < seconds - 2.0 * legged.swing:
            feet = groups[(len(swings) + turn) % len(groups)]
            length = legged.swing if legged.holds(feet) else legged.hop
            swings.append((start, length, feet))
            start += length + legged.both
        places = rng.uniform(-0.025, 0.025, (len(swings), len(home), 3)) * [1.0, 1.0, 0.0]
        strides, at = np.zeros_like(places), np.zeros_like(home)
        for k, (*_, feet) in enumerate(swings):
            for foot in feet:
                strides[k, foot] = places[k, foot] - at[foot]
                at[foot] = places[k, foot]
        return cls(legged, home, swings, strides)

    def feet(self, time: Array) -> tuple[Array, Array]:
        """Positions (N, F, 3) [m], and readiness to carry (N, F), 0 in the air."""
        place = np.repeat(self.home[None], len(time), axis=0)
        ready = np.ones((len(time), len(self.home)))
        for (start, swing, feet), stride in zip(self.swings, self.strides, strict=True):
            progress, height, carries = Swing.at(time, start, swing, self.legged.lift, _RAMP)
            for foot in feet:
                place[:, foot] += progress[:, None] * stride[foot]
                place[:, foot, 2] += height
                ready[:, foot] = np.minimum(ready[:, foot], carries)
        return place, ready

    def support(self, time: Array) -> Array:
        """Horizontal path (N, 2) [m] from one middle of the feet that stand to the next, at rest while others swing."""
        middle = self.home[:, :2].mean(axis=0)
        knots, places = [-1.0, 0.0], [middle, middle]
        for start, seconds, feet in self.swings:
            place, _ = self.feet(np.array([start + 0.5 * seconds]))
            knots += [start, start + seconds]
            places += [np.delete(place[0, :, :2], list(feet), axis=0).mean(axis=0)] * 2
        index = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
        began, length, path = np.array(knots)[index], np.diff(knots)[index], np.array(places)
        return path[index] + quintic((time - began) / length)[:, None] * (path[index + 1] - path[index])


def balanced_path(support: Array, height: float) -> Array:
    """Path (N, 2) [m] of a centre of mass, at so many metres, whose zero-moment point is `support` at all knots."""
    pull = height / _GRAVITY * _KNOTS_HZ**2
    bands = np.full((3, len(support)), -pull)
    bands[1] = 1.0 + 2.0 * pull
    bands[1, [0, -1]] = 1.0 + pull  # at rest at both ends
    return np.asarray(solve_banded((1, 1), bands, support))


@dataclass(frozen=True)
class Motion:
    """A prescribed motion in MuJoCo's coordinates at stamps (N,): q (N, 7 + n), v and a (N, 6 + n), ready (N, F)."""

    time: Array
    q: Array
    v: Array
    a: Array
    ready: Array


class Reference:
    """The prescribed motion of a robot, at any time."""

    def __init__(self, true: TrueRobot, seconds: float, seed: int, static: bool = False) -> None:
        """Plan it; `static`: never on two points alone, which cannot hold the base.

        Raises:
            ValueError: the feet are out of reach.
        """
        legged, robot = true.legged, true.robot
        rng = np.random.default_rng([seed, 5])
        knots = np.arange(round((seconds + 0.5) * _KNOTS_HZ) + 1) / _KNOTS_HZ
        posture = np.array([legged.posture.get(name, 0.0) for name in robot.joint_names])
        legs = _Legs(true)
        home, com, height = legs.stand(posture)
        groups = [feet for feet in legged.lifted if not static or legged.holds(feet)]
        self.steps = Steps.plan(legged, home, float(knots[-1]), groups, rng)
        swaying = waves(rng, knots, 6, 0.2, 1.2) * quintic(knots / _START)[:, None]
        place, _ = self.steps.feet(knots)
        base = 4.0 * legged.sway * swaying
        base[:, :3] = 0.0
        base[:, 2] = height - _LOWERED - legged.sway + legged.sway * swaying[:, 2]
        centre = balanced_path(self.steps.support(knots), com[2]) + 0.3 * legged.sway * swaying[:, :2]
        base[:, :2] = centre - com[:2]
        joints = posture + legged.waving * waves(rng, knots, robot.n, 0.15, 0.9)
        for _ in range(_CORRECTIONS):
            reached, found = legs.reach(base, joints, place)
            base[:, :2] += centre - found[:, :2]
        reached, _ = legs.reach(base, joints, place)
        self._base, self._joints = make_interp_spline(knots, base, k=5), make_interp_spline(knots, reached, k=5)

    def at(self, time: Array) -> Motion:
        """The motion at stamps (N,) [s]."""
        base = BaseMotion.along(self._base, time)
        quat = base.rotation.as_quat()[:, [3, 0, 1, 2]]
        q = np.hstack([self._base(time)[:, :3], quat, self._joints(time)])
        v = np.hstack([base.linear, base.angular, self._joints(time, 1)])
        a = np.hstack([base.linear_rate, base.angular_rate, self._joints(time, 2)])
        return Motion(time, q, v, a, self.steps.feet(time)[1])


class _Legs:
    """Inverse kinematics of the legs, one foot after the other, with MuJoCo's Jacobians."""

    def __init__(self, true: TrueRobot) -> None:
        self._true, self._model, self._data = true, true.model, mujoco.MjData(true.model)
        robot, legged = true.robot, true.legged
        centre = np.append(np.mean(legged.points, axis=0), 1.0)
        self._feet = []
        for frame in legged.feet:
            body, T = robot.links[frame]
            index, place = self._model.body(robot.body_names[body]).id, (T @ centre)[:3]
            self._feet.append((index, place, _leg(self._model, index)))
        self._size = 6 if legged.kind == "flat" else 3

    def stand(self, posture: Array) -> tuple[Array, Array, float]:
        """Feet (F, 3), centre of mass (3,) and height of the base [m], of a posture with the spheres on the ground."""
        self._place(np.zeros(6), posture)
        feet = np.array([self._centre(index, place) for index, place, _ in self._feet])
        radius = sphere_radius(self._true.legged)
        height = radius - float(feet[:, 2].mean())
        feet[:, 2] = radius
        return feet, self._data.subtree_com[1] + [0.0, 0.0, height], height

    def reach(self, base: Array, joints: Array, targets: Array) -> tuple[Array, Array]:
        """Joint positions (N, n), those of legs such that feet are at targets (N, F, 3), flat ones level; and the CoM.

        Raises:
            ValueError: out of reach.
        """
        out, com = joints.copy(), np.zeros((len(joints), 3))
        for i in range(len(out)):
            for _, _, leg in self._feet:
                out[i, leg] = out[max(i - 1, 0), leg]
            for _ in range(_ITERATIONS):
                self._place(base[i], out[i])
                worst = max(
                    self._improve(out[i], foot, target) for foot, target in zip(self._feet, targets[i], strict=True)
                )
                if worst < _REACHED:
                    break
            else:
                raise ValueError(f"{self._true.legged.name}: out of reach at knot {i} by {worst:.2g}")
            com[i] = self._data.subtree_com[1]
        return out, com

    def _improve(self, joints: Array, foot: tuple[int, Array, Array], target: Array) -> float:
        index, place, leg = foot
        centre = self._centre(index, place)
        J = np.zeros((6, self._model.nv))
        mujoco.mj_jac(self._model, self._data, J[:3], J[3:], centre, index)
        error = target - centre
        if self._size > 3:
            error = np.append(error, -Rotation.from_matrix(self._data.xmat[index].reshape(3, 3)).as_rotvec())
        A = J[: self._size, leg + 6]
        joints[leg] += A.T @ np.linalg.solve(A @ A.T + 1e-9 * np.eye(len(A)), error)
        return float(np.abs(error).max())

    def _place(self, base: Array, joints: Array) -> None:
        quat = Rotation.from_euler("ZYX", base[3:]).as_quat()[[3, 0, 1, 2]]
        self._data.qpos[:] = np.concatenate([base[:3], quat, joints])
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def _centre(self, index: int, place: Array) -> Array:
        return np.asarray(self._data.xpos[index] + self._data.xmat[index].reshape(3, 3) @ place)


def _leg(model: Any, index: int) -> Array:
    """Joints between the base and a body, by number."""
    found = []
    while model.body_parentid[index] != 0:
        found.append(int(model.body_dofadr[index]) - 6)
        index = int(model.body_parentid[index])
    return np.array(found[::-1])
