"""Small robots to plan sensors for, and the projection as an oracle of which sets suffice."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import torch
from synthetic import Oracle, load, random_states
from urdfs import joint, link, write

from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.contact_state import ContactState
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values, null_space
from torchid.sensor_planning.observability import Candidate, candidates, sensor_set

RANDOM = "random"  # an axis
NOISE = SensorNoise(joint_torque=0.7, contact_force=3.0, contact_moment=0.4, base_force=5.0, base_moment=1.0)


def states_of(*rows: str) -> tuple[ContactState, ...]:
    """Contact states from strings of 0 and 1."""
    return tuple(tuple(digit == "1" for digit in row) for row in rows)


@dataclass(frozen=True)
class Machine:
    """Chains of joints, each from a named link, with contacts and the states they touch in.

    A chain `{"leg": ("base", ("x", "slide z", RANDOM))}` has links leg1, leg2, ... at random poses; but "y" turns
    nothing and stays in the plane, so that a chain of these is planar. A "weld" can carry a force/torque sensor.
    """

    chains: dict[str, tuple[str, tuple[str, ...]]]
    contacts: tuple[Contact, ...]
    states: tuple[ContactState, ...]
    per: str = "axis"
    seed: int = 3
    mimics: dict[str, str] = field(default_factory=dict)

    def robot(self, folder: Path) -> Robot:
        rng, parts, welds = np.random.default_rng(self.seed), [link("base")], list[str]()
        for name, (parent, axes) in self.chains.items():
            for place, kind in enumerate(axes, start=1):
                child, planar = f"{name}{place}", "y" in kind
                turned = "0 0 0" if planar else numbers(rng.uniform(-1, 1, 3))
                axis = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}.get(kind[-1]) or numbers(rng.normal(size=3))
                offset = rng.uniform(-0.4, 0.4, 3) * ([1, 0, 1] if planar else 1)
                extra = '<limit lower="-9" upper="9" effort="9" velocity="9"/>'
                extra += f'<origin xyz="{numbers(offset)}" rpy="{turned}"/><axis xyz="{axis}"/>'
                if child in self.mimics:
                    extra += f'<mimic joint="{self.mimics[child]}" multiplier="-0.7"/>'
                sliding = "fixed" if kind == "weld" else "prismatic" if kind.startswith("slide") else "revolute"
                parts += [link(child), joint(f"j_{child}", parent, child, sliding, extra)]
                welds += [f"j_{child}"] if kind == "weld" else []
                parent = child
        return load(write(folder, *parts), ft_joints=welds)


def numbers(x: np.ndarray) -> str:
    """As an attribute."""
    return " ".join(f"{value:.6f}" for value in x)


def subsets(count: int) -> np.ndarray:
    """Membership (2^count, count) bool of all sets."""
    return (np.arange(2**count)[:, None] >> np.arange(count)) & 1 == 1


def sees_the_base(
    robot: Robot, contacts: Sequence[Contact], states: Sequence[ContactState], sets: Sequence[SensorSet]
) -> np.ndarray:
    """Which sets give rank(S_b V_x) = 6 in every state, at one random posture each, with Pinocchio's Jacobians."""
    oracle, result = Oracle.of(robot), np.ones(len(sets), dtype=bool)
    for number, state in enumerate(states):
        q = random_states(np.random.default_rng(number), robot.n, 1)[0]
        torque = np.eye(6 + robot.n_dofs)[6:]
        rows = [(c, k) for c, active in enumerate(state) if active for k in contacts[c].components]
        J = {c: _along_axes(oracle, q, contacts[c]) for c in {c for c, _ in rows}}
        A = np.vstack([torque, *(J[c][[k]] for c, k in rows)])
        measured = np.array([[*s.torque, *(s.wrench[c, k] for c, k in rows)] for s in sets])
        unmeasured = torch.from_numpy(A * ~measured[..., None])
        for index, V in null_space(unmeasured):
            rank = base_rank(base_singular_values(V)).numpy()
            result[np.arange(len(sets))[index]] &= rank == 6
    return result


def _along_axes(oracle: Oracle, q: np.ndarray, contact: Contact) -> np.ndarray:
    """Jacobian (6, n_rows) of a contact along its frame's axes, the force of a scalar sensor along the vertical."""
    J: np.ndarray = oracle.jacobian(q, contact.frame)[0]
    if contact.along_normal:
        rotation = oracle.pose(q, contact.frame)[0][0]
        J = np.vstack([rotation @ J[:3], J[3:]])
    return J


def sufficient_sets(machine: Machine, robot: Robot, choice: Sequence[Candidate]) -> np.ndarray:
    """Which of all sets of the candidates see the base, (2^m,) bool."""
    sets = [
        sensor_set(robot, machine.contacts, [c for c, taken in zip(choice, row, strict=True) if taken])
        for row in subsets(len(choice))
    ]
    return sees_the_base(robot, machine.contacts, machine.states, sets)


def minimal_of(sufficient: np.ndarray, choice: Sequence[Candidate]) -> set[frozenset[Candidate]]:
    """Sets that lose the base without any one of their members."""
    number = np.arange(len(sufficient))
    minimal = sufficient.copy()
    for bit in range(len(choice)):
        there = (number >> bit) & 1 == 1
        minimal &= ~(there & sufficient[number & ~(1 << bit)])
    member = subsets(len(choice))
    return {frozenset(choice[k] for k in np.flatnonzero(member[row])) for row in np.flatnonzero(minimal)}


def axes_and_devices(machine: Machine, robot: Robot, costs: dict[str, float] | None = None) -> tuple[Candidate, ...]:
    """The machine's candidates."""
    return candidates(robot, machine.contacts, per=machine.per, costs=costs, ft_sensors=robot.ft_names)


SIX = (RANDOM,) * 6
MACHINES = {
    "a leg on a flat foot": Machine({"leg": ("base", SIX)}, (Contact("leg6", "flat"),), states_of("1"), "device"),
    "a leg on a flat foot, axis by axis": Machine({"leg": ("base", SIX)}, (Contact("leg6", "flat"),), states_of("1")),
    "double support and steps": Machine(
        {"left": ("base", (RANDOM,) * 3), "right": ("base", (RANDOM,) * 4), "arm": ("base", ("x", "z"))},
        (Contact("left3", "point"), Contact("right4", "point")),
        states_of("11", "10", "01"),
        "device",
    ),
    "always on one of two feet": Machine(
        {"left": ("base", (RANDOM,) * 3), "right": ("base", (RANDOM,) * 3)},
        (Contact("left3", "point"), Contact("right3", "point")),
        states_of("10", "01"),
    ),
    "hands on a trunk": Machine(
        {"trunk": ("base", (RANDOM,) * 2), "left": ("trunk2", (RANDOM,) * 2), "right": ("trunk2", (RANDOM,) * 2)},
        (Contact("left2", "point"), Contact("right2", "point")),
        states_of("11", "10"),
    ),
    "both hands at once": Machine(
        {"trunk": ("base", (RANDOM,) * 2), "left": ("trunk2", (RANDOM,) * 4), "right": ("trunk2", (RANDOM,) * 4)},
        (Contact("left4", "point"), Contact("right4", "point")),
        states_of("11"),
        "device",
    ),
    "toe and heel": Machine(
        {"leg": ("base", SIX)}, (Contact("leg6", "point"), Contact("leg5", "point")), states_of("11", "10")
    ),
    "toe and heel of one foot, a line": Machine(
        {"leg": ("base", (*SIX[:5], RANDOM))},
        (Contact("leg5", "line", "x"), Contact("leg6", "point")),
        states_of("11"),
        "device",
    ),
    "the base on the ground": Machine(
        {"leg": ("base", (RANDOM,) * 3)},
        (Contact("base", "point"), Contact("leg3", "point")),
        states_of("11", "01"),
    ),
    "a planar leg": Machine({"leg": ("base", ("y",) * 6)}, (Contact("leg6", "flat"),), states_of("1")),
    "a planar leg on a point": Machine({"leg": ("base", ("y",) * 4)}, (Contact("leg4", "point"),), states_of("1")),
    "a wheel on a line": Machine({"leg": ("base", SIX)}, (Contact("leg6", "line", "y"),), states_of("1")),
    "a slide": Machine(
        {"leg": ("base", ("slide z", "x", "slide x", "slide y"))}, (Contact("leg4", "flat"),), states_of("1")
    ),
    "a sensor in the ankle": Machine(
        {"leg": ("base", (RANDOM, RANDOM, RANDOM, "weld", RANDOM, RANDOM))},
        (Contact("leg6", "flat"),),
        states_of("1"),
        "device",
    ),
    "a sensor in the ankle, axis by axis": Machine(
        {"leg": ("base", (RANDOM, RANDOM, "weld", RANDOM))}, (Contact("leg4", "point"),), states_of("1")
    ),
    "sensors in two limbs and in the trunk that they share": Machine(
        {
            "trunk": ("base", (RANDOM, "weld", RANDOM)),
            "left": ("trunk3", (RANDOM, "weld")),
            "right": ("trunk3", ("weld", RANDOM)),
        },
        (Contact("left2", "point"), Contact("right2", "line")),
        states_of("11", "10", "01"),
        "device",
    ),
    "a weld alone between base and toes": Machine(
        {"leg": ("base", ("weld",)), "toe": ("leg1", (RANDOM, RANDOM))},
        (Contact("leg1", "point"), Contact("toe2", "point")),
        states_of("11", "01"),
        "device",
    ),
    "a joint that mimics another": Machine(
        {"leg": ("base", (RANDOM,) * 5)}, (Contact("leg5", "line"),), states_of("1"), mimics={"leg4": "j_leg2"}
    ),
}


@cache
def tried(name: str) -> tuple[Robot, tuple[Candidate, ...], np.ndarray]:
    """A machine's robot, its candidates at a cost of 1 per channel, and which of all sets suffice."""
    machine = MACHINES[name]
    with tempfile.TemporaryDirectory() as folder:
        robot = machine.robot(Path(folder))
        choice = axes_and_devices(machine, robot)
        return robot, choice, sufficient_sets(machine, robot, choice)


@one_thread()
def bits(
    robot: Robot, contacts: tuple[Contact, ...], logs: list[Samples], chosen: tuple[Candidate, ...], prior: Array
) -> float:
    """log2 det(I + H) / 2, of all rows."""
    builder = RowBuilder(robot, contacts, sensor_set(robot, contacts, chosen, NOISE))
    A = linear_problem(compress(logs, builder), builder, robot).A * prior
    return float(np.log1p(np.linalg.svd(A, compute_uv=False) ** 2).sum() / np.log(4.0))
