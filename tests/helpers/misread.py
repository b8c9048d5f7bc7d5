"""A machine that differs from its URDF, read by sensors with offsets and scales."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from motions import value
from recordings import Miscalibration, in_world, on_plates
from synthetic import Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.logs import Log
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import ExtraTerms, RowBuilder
from torchid.robot import Robot
from torchid.sensing.sensors import recorded_components

KINDS = {"f": "force", "m": "moment"}
WIDTH = 0.3  # [rad/s] of the sign of velocities


@dataclass(frozen=True)
class World:
    """A machine that differs from its URDF, what was recorded of it, and by which sensors."""

    robot: Robot
    oracle: Oracle
    logs: list[Log]
    sensors: list[Miscalibration]

    def true(self, builder: RowBuilder, terms: ExtraTerms) -> dict[tuple[str, str], float]:
        """Offsets, and scales less 1, of the channels that are unknown and read, by log and label."""
        out = {}
        for log, found in zip(self.logs, self.sensors, strict=True):
            read = recorded_components(builder.contacts, builder.sensors, log.contact_wrench_world is not None)
            for what, scopes, less in (("offset", terms.offsets, 0.0), ("scale", terms.scales, 1.0)):
                torque, wrench, ft = (
                    getattr(found, name if what == "offset" else f"{name}_scale") - less
                    for name in ("torque", "wrench", "ft")
                )
                channels = [("joint_torque", name, x) for name, x in zip(self.robot.joint_names, torque, strict=True)]
                for name, x in zip(self.robot.dof_names[self.robot.n :], ft.flatten(), strict=True):
                    joint, _, component = name.rpartition(".")
                    channels.append((f"ft_{KINDS[component[0]]}", f"limb sensor {joint} {component}", x))
                chosen = [channel for channel, taken in zip(channels, builder.sensors.torque, strict=True) if taken]
                for c, k in np.argwhere(read):
                    component = WRENCH_COMPONENTS[k]
                    name = f"{builder.contacts[c].frame} {component}"
                    chosen.append((f"contact_{KINDS[component[0]]}", name, wrench[c, k]))
                for channel, name, x in chosen:
                    if channel in scopes:
                        out[log.source if scopes[channel] == "log" else "", f"{what} of {name}"] = x
        return out


@cache
def world(per_log: bool = True, scaled: tuple[str, ...] = (), axes: str = "local") -> World:
    """Two logs of the skew machine, each with its own sensors if `per_log`."""
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        robot = load(machine(Path(folder)), None, False, SENSORS)
        oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    contacts = [(contact.frame, len(contact.components)) for contact in CONTACTS]
    logs, sensors = [], []
    for name in ("a.npz", "b.npz"):
        log = make_log(oracle, contacts, STATES, 120, rng, name)
        found = Miscalibration.random(log, rng, scaled)
        sensors.append(found if per_log or not sensors else sensors[0])
        change = {"local": lambda _, log: log, "world": in_world, "plates": on_plates}[axes]
        logs.append(sensors[-1].read(change(oracle, log)))
    return World(robot, oracle, logs, sensors)


def with_actuators(w: World, terms: ExtraTerms) -> tuple[list[Log], dict[tuple[str, str], float]]:
    """The logs of calibrated sensors on a robot with smooth friction and the terms, and their values."""
    rng, n = np.random.default_rng(5), w.robot.n
    armature, offset, half = rng.uniform(0.1, 0.5, n), rng.uniform(-5, 5, n), rng.uniform(-0.5, 0.5, n)
    stiffness, at_rest = rng.uniform(-2, 2, n), rng.uniform(0.5, 2, n)
    logs = []
    for log, sensors in zip(w.logs, w.sensors, strict=True):
        v = value(log.joint_velocity)
        moving = v @ w.oracle.ratios.T
        smooth = (w.oracle.friction[:, 0] * (np.tanh(moving / WIDTH) - np.sign(moving))) @ w.oracle.ratios
        torque = value(log.joint_torque) * sensors.torque_scale - sensors.torque + smooth
        torque = torque + terms.armature * armature * value(log.joint_acceleration) + terms.torque_offset * offset
        torque = torque + terms.asymmetric_coulomb * half * np.abs(np.tanh(v / WIDTH))
        torque = torque + terms.stiffness * stiffness * value(log.joint_position)
        if terms.stribeck:
            torque = torque + at_rest * np.tanh(v / WIDTH) * np.exp(-np.square(v / terms.stribeck))
        ft, wrench = value(log.ft_wrench) - sensors.ft, value(log.contact_wrench_local) - sensors.wrench
        logs.append(replace(log, joint_torque=torque, ft_wrench=ft, contact_wrench_local=wrench))
    labels = {
        "armature": armature,
        "torque offset": offset,
        "asymmetric Coulomb friction": half,
        "stiffness": stiffness,
        "Stribeck friction": at_rest,
    }
    wanted = {"armature": terms.armature, "torque offset": terms.torque_offset, "stiffness": terms.stiffness}
    wanted["asymmetric Coulomb friction"] = terms.asymmetric_coulomb
    wanted["Stribeck friction"] = bool(terms.stribeck)
    true = {("", f"{what} of {j}"): float(x[k]) for what, x in labels.items() if wanted[what]
            for k, j in enumerate(w.robot.joint_names)}  # fmt: skip
    return logs, true
