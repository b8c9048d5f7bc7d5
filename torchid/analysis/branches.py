"""The robot's limbs, which of them a contact constrains, and how many sensors each group of contacts needs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from torchid.analysis.candidates import candidates
from torchid.analysis.cheapest_set import cheapest_set
from torchid.analysis.demands import demands
from torchid.problem.plan import State
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing.contacts import Contact


@dataclass(frozen=True)
class Branch:
    """A chain of joints between the base, a body where limbs part, and a tip.

    `joints`: its independent joints, from the base outward. `contacts`: frames beyond it that some state uses.
    """

    joints: tuple[str, ...]
    contacts: tuple[str, ...]

    @property
    def name(self) -> str:
        """First and last joint."""
        return self.joints[0] if len(self.joints) == 1 else f"{self.joints[0]} ... {self.joints[-1]}"

    @property
    def constrained(self) -> bool:
        """Whether a contact lies beyond it; sensors in other branches say nothing about the base."""
        return bool(self.contacts)


@dataclass(frozen=True)
class Need:
    """A group of contacts that share joints, and what it takes to know the base while they touch.

    `joints`: between the base and the contacts. `branches`: names of the branches these belong to. `needed`: the fewest
    readings (joint torques, contact components) that meet this group's demand alone, a lower bound if not `proven`.
    """

    contacts: tuple[str, ...]
    joints: tuple[str, ...]
    branches: tuple[str, ...]
    needed: int
    proven: bool


def branches(robot: Robot, contacts: Sequence[Contact], states: Iterable[State]) -> tuple[Branch, ...]:
    """All branches with joints of their own, depth first; a finger that only mimics has none."""
    used = [contact.frame for contact, *active in zip(contacts, *states, strict=True) if any(active)]
    tree = KinematicTree(robot)
    above = {frame: {tree.body_of[node] for node in tree.path(tree.frame(robot, frame)[0])} for frame in used}
    children, found = robot.children, []
    for first, body in enumerate(robot.bodies[1:], start=1):
        if body.parent > 0 and len(children[body.parent]) == 1:
            continue
        chain = [first]
        while len(children[chain[-1]]) == 1:
            chain += children[chain[-1]]
        names = [joint.name for k in chain if (joint := robot.bodies[k].joint) is not None]
        joints = tuple(name for name in names if name in robot.joint_names)
        if joints:
            found.append(Branch(joints, tuple(frame for frame in used if first in above[frame])))
    return tuple(found)


def needs(robot: Robot, contacts: Sequence[Contact], states: Iterable[State], seed: int = 0) -> tuple[Need, ...]:
    """What every group of contacts needs if all joint torques and contact components could be measured."""
    states = tuple(states)
    limbs = branches(robot, contacts, states)
    channels = candidates(robot, contacts, per="axis")
    found = []
    for demand in demands(robot, contacts, states, channels, seed):
        least = cheapest_set([demand], channels)
        joints = tuple(robot.joint_names[j] for j in demand.joints)
        through = tuple(limb.name for limb in limbs if not set(limb.joints).isdisjoint(joints))
        found.append(Need(demand.frames, joints, through, round(least.lower_bound), least.proven))
    return tuple(found)
