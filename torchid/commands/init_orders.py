"""The order of joints and feet that no name in a file says, as limits of joints and the forces say it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.commands.init_proposals import GuessedContact
from torchid.config.robot import ContactConfig
from torchid.errors import InputError, TorchidWarning, join_names
from torchid.fitting.experiment import resolve_contacts
from torchid.log_checks.forces import MAX_FORCE_RESIDUAL_SHARE, MAX_MISFIT
from torchid.log_checks.mistakes import joint_orders
from torchid.log_checks.model import NominalModel, bind_some_samples, default_cutoff_hz, preprocess_pieces
from torchid.logs import Log
from torchid.logs.name_matching import limb_and_words
from torchid.logs.unitree import JOINT_ORDERS, suitable_orders
from torchid.problem.contact_detection import with_detected_contacts
from torchid.proposals.column_groups import MapProposal
from torchid.robot import Robot, load_robot
from torchid.robot.urdf import position_limits
from torchid.settings import AUTO

_BEYOND = 0.1  # [rad or m], by which joints pass their limits where these are not hard
_SECONDS = 20.0  # of a recording that are compared


@dataclass(frozen=True)
class _Order:
    """Names of the columns of joints and of contacts, and what they are called.

    Attributes:
        how: in words, "" for the usual ones.
        joints, feet: in the order of columns.
    """

    how: str
    joints: tuple[str, ...]
    feet: tuple[str, ...]

    def of(self, log: Log) -> Log:
        """A log with these names."""
        return replace(log, joint_names=self.joints, contact_names=self.feet)


Reader = Callable[[MapProposal], list[Log] | InputError]
"""What reads the recordings of a log with a map, or says why it is not read."""


def settle_order(
    proposal: MapProposal, read: Reader, robot: Robot, contacts: Sequence[GuessedContact], bolted: bool, detects: bool
) -> list[Log] | InputError:
    """The recordings of a log, with another program's order of joints where limits or forces contradict the usual.

    Args:
        proposal: gets another order that the file does not say, or a note.
        read: the recordings.
        robot: whose log it is.
        contacts: of it.
        bolted: whether its base is fixed.
        detects: whether joint torques say which contacts touch.
    """
    logs, order = read(proposal), proposal.columns.get("joint_order", ())
    numbers = JOINT_ORDERS[order].joints if isinstance(order, str) else order
    if isinstance(logs, InputError) or "joint_order" not in proposal.guessed_orders or None in numbers:
        return logs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # said of the robot already, and of trials
        if bolted and not robot.fixed_base:
            robot = load_robot(robot.path, fixed_base=True, total_mass=float(robot.nominal[:, 0].sum()))
        is_other = sorted(logs[0].joint_names) == sorted(robot.joint_names) and _settle(
            proposal, logs[0], robot, contacts, detects
        )
    return read(proposal) if is_other else logs


def _settle(proposal: MapProposal, log: Log, robot: Robot, contacts: Sequence[GuessedContact], detects: bool) -> bool:
    """Whether a proposal has got another order of joints."""
    usual, *others = _orders(proposal, log, robot)
    outside = _outside(usual.of(log), robot)
    fitting = [one for one in others if not _outside(one.of(log), robot)]
    misfits = _misfits([usual, *fitting], log, robot, contacts, detects)
    best = min(misfits, key=lambda one: misfits[one], default=usual)
    if usual in misfits:
        least, differ = misfits[best], f"forces differ from the robot's file by {misfits[usual]:.0%} in"
        if least < MAX_FORCE_RESIDUAL_SHARE * min(misfits[usual], 1.0):
            return _take(best, proposal, f"{best.how}: {differ} the usual one, by {least:.0%} in this")
        proposal.notes["joint_order"] += f"; {differ} it" + ", no other explains much more" * (least > MAX_MISFIT)
    if not outside:
        return False
    beyond = f"with {join_names(outside)} beyond {'its' if len(outside) == 1 else 'their'} limits"
    if not fitting:
        proposal.notes["joint_order"] += f"; {beyond}"
        return False
    more = f"; or {fitting[1].how}" if len(fitting) > 1 else ""
    return _take(fitting[0], proposal, f"{fitting[0].how}, as the usual one is {beyond}{more}; a guess")


def _orders(proposal: MapProposal, log: Log, robot: Robot) -> Iterator[_Order]:
    """The order of a log first, then those of other programs; feet as in the file, or as joints name their legs."""
    yield _Order("", log.joint_names, log.contact_names)
    known = {(log.joint_names, log.contact_names)}
    makers = {f"the order of {name}": JOINT_ORDERS[name].names for name in suitable_orders(robot.joint_names)}
    named = {"the usual order": log.joint_names, **joint_orders(robot), **makers}
    for how, joints in ((how, x) for how, x in named.items() if sorted(x) == sorted(log.joint_names)):
        all_feet = [log.contact_names]
        if "contact_order" in proposal.guessed_orders:
            sides = {limb_and_words(foot)[0]: foot for foot in log.contact_names}
            legs = dict.fromkeys(limb_and_words(name)[0] for name in joints)
            all_feet.append(tuple(sides[side] for side in legs if side in sides))
        for feet in all_feet:
            if (joints, feet) not in known and sorted(feet) == sorted(log.contact_names):
                known.add((joints, feet))
                yield _Order(how + ", feet as joints" * (feet != log.contact_names), joints, feet)


def _outside(log: Log, robot: Robot) -> list[str]:
    """Joints that are beyond their limits."""
    limits = position_limits(robot.path) if robot.format == "URDF" else {}
    low, high = np.nanmin(log.joint_position, axis=0), np.nanmax(log.joint_position, axis=0)
    ranges = np.array([limits.get(name, (-np.inf, np.inf)) for name in log.joint_names])
    is_out = (low < ranges[:, 0] - _BEYOND) | (high > ranges[:, 1] + _BEYOND)
    return [name for name, out in zip(log.joint_names, is_out, strict=True) if out]


def _misfits(
    orders: Sequence[_Order], log: Log, robot: Robot, contacts: Sequence[GuessedContact], detects: bool
) -> dict[_Order, float]:
    """What the forces of a log differ by from those of the robot's file, of orders in which they can be compared."""
    log = log.select(log.time < log.time[0] + _SECONDS)
    given = [ContactConfig(x.frame, x.type, radius=AUTO if x.radius is None else x.radius) for x in contacts]
    out, (resolved, _) = dict[_Order, float](), resolve_contacts(given, robot)
    model = NominalModel(robot, resolved)
    for order in orders:
        try:
            named = order.of(log)
            named = with_detected_contacts(named, robot, resolved)[0] if detects else named
            samples = bind_some_samples(preprocess_pieces(named, default_cutoff_hz(log)), robot, resolved)
            fit = model.compare(samples)
        except InputError:
            continue
        torque = None if fit.torque is None else fit.torque.misfit
        parts = [x for x in (torque, fit.base_force, fit.base_moment) if x is not None]
        if parts:
            out[order] = float(np.sqrt(np.mean(np.square(parts))))
    return out


def _take(order: _Order, proposal: MapProposal, why: str) -> bool:
    proposal.columns["joint_order"] = list(order.joints)
    proposal.notes["joint_order"] = f"{why}; compare it with what torchid check says"
    if "contact_order" in proposal.guessed_orders and "contact_order" in proposal.columns:
        proposal.columns["contact_order"] = list(order.feet)
        proposal.notes["contact_order"] = "with the order of joints; compare it with what torchid check says"
    return True
