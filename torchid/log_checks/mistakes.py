"""Common mistakes in logs, each with the function that corrects it, and other orders of joints and contacts."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchid.errors import join_names
from torchid.log_checks.motion import INVERSE_QUATERNION, MAX_ANGLE_RAD, QUATERNION_ORDER
from torchid.logs import Log
from torchid.logs.log import WRENCHES, FloatArray
from torchid.logs.quaternion import inverse_rotation, make_sign_continuous, rotate_to_base
from torchid.logs.units import advise_units, other_units
from torchid.robot import Robot

#: Parts of names that differ between left and right, and between front and rear.
_SIDES = ("left right", "Left Right", "LEFT RIGHT", "l r", "L R", "FL FR", "RL RR", "HL HR", "LF RF", "LH RH")
_ENDS = (
    *("front rear", "front hind", "front back", "fore hind", "Front Rear", "FL RL", "FR RR", "LF LH", "RF RH"),
    *("fl rl", "fr rr", "lf lh", "rf rh"),
)
_ENDS_OF_ROBOTS = ("left and right", "front and rear")
_NAME_PARTS = re.compile(r"([A-Za-z0-9]+)")
_WORDS = re.compile(r"([A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+)")
#: Largest number of pairs of limbs that are tried.
_MAX_PAIRS = 28
#: Joints of a limb whose names may be exchanged: neighbours, and those with one between.
_MOST_APART = 2


def exchanged_names(names: Sequence[str], shortest: int = 2) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible true names of the columns, with a description: sides, ends, two limbs, or the order.

    `shortest`: fewest names of a limb.
    """
    known = {tuple(names)}
    for description, pairs in zip(_ENDS_OF_ROBOTS, (_SIDES, _ENDS), strict=True):
        permuted = _exchanged(names, pairs)
        if permuted is not None and permuted not in known:
            known.add(permuted)
            yield description, permuted
    for description, permuted in (
        *_exchanged_pairs(names, shortest),
        ("alphabetical and given order", tuple(sorted(names))),
        ("the two ends of the order", tuple(names[::-1])),
    ):
        if permuted not in known and len(names) > 1:
            known.add(permuted)
            yield description, permuted


def _exchanged(names: Sequence[str], pairs: Sequence[str]) -> tuple[str, ...] | None:
    """Names with their parts exchanged within each pair; None unless that permutes the names."""
    for some in (pairs, *([pair] for pair in pairs)):  # all pairs at once, else one at a time: some share a part
        partner = {old: new for pair in some for old, new in (pair.split(), pair.split()[::-1])}
        exchanged = tuple("".join(partner.get(part, part) for part in _NAME_PARTS.split(name)) for name in names)
        if sorted(exchanged) == sorted(names) and exchanged != tuple(names):
            return exchanged
    return _by_first_letter(names) if pairs is _SIDES else None


def _exchanged_pairs(names: Sequence[str], shortest: int) -> list[tuple[str, tuple[str, ...]]]:
    """The names with two limbs exchanged; their names differ in one or two words, as `lf_hip` and `rf_hip`.

    Limbs have at least `shortest` names. Empty if there are too many pairs of limbs to try.
    """
    limbs: dict[tuple[int, int], dict[str, dict[tuple[str, str], str]]] = {}  # by place, limb, and what is beside it
    for name in names:
        words = _WORDS.split(name)
        for first, last in ((1, 4), *((word, word + 1) for word in range(1, len(words), 2))):
            before, limb, after = ("".join(part) for part in (words[:first], words[first:last], words[last:]))
            limbs.setdefault((first, last), {}).setdefault(limb, {})[before, after] = name
    exchanged: dict[tuple[str, ...], str] = {}
    for of_place in limbs.values():
        for (one, its), (other, others) in itertools.combinations(of_place.items(), 2):
            if its.keys() == others.keys() and len(its) >= shortest:
                partner = {a: b for key in its for a, b in ((its[key], others[key]), (others[key], its[key]))}
                exchanged.setdefault(tuple(partner.get(name, name) for name in names), f"{one} and {other}")
    return [(text, permuted) for permuted, text in exchanged.items()] if len(exchanged) <= _MAX_PAIRS else []


def _by_first_letter(names: Sequence[str]) -> tuple[str, ...] | None:
    """Names with left and right exchanged by first letter: LAnkle and RAnkle, lfoot and rfoot."""
    swap = {"L": "R", "R": "L", "l": "r", "r": "l"}
    swapped = tuple(
        other if name[:1] in swap and (other := swap[name[0]] + name[1:]) in names else name for name in names
    )
    return swapped if swapped != tuple(names) else None


def joint_orders(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Usual orders of a robot's joints in programs without joint names, by description.

    Dynamics libraries and MuJoCo go depth first, Isaac Lab breadth first. Isaac Gym and USD exporters sort limbs by
    name, others keep the order of the file.
    """
    names = {number: body.joint.name for number, body in enumerate(robot.bodies) if body.joint is not None}

    def listed(body: int, by_name: bool) -> list[int]:
        return sorted(robot.children[body], key=names.__getitem__) if by_name else list(robot.children[body])

    out = {}
    for by_name in (False, True):
        orders: dict[str, list[int]] = {"depth": [], "breadth": []}
        for kind, order in orders.items():
            waiting = [0]
            while waiting:
                body = waiting.pop(0)
                order.append(body)
                beyond = listed(body, by_name)
                waiting = beyond + waiting if kind == "depth" else waiting + beyond
            joints = tuple(names[body] for body in order[1:] if names[body] in robot.joint_names)
            out[f"{kind}-first order{', limbs by name' if by_name else ''}"] = joints
    return out


def other_orders(names: Sequence[str], robot: Robot | None) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Possible true names of the joint columns, with a description: `exchanged_names` and orders of other programs.

    Orders of other programs need the `robot`, and come also with left and right, or front and rear, exchanged.
    """
    known = {tuple(names)}
    for description, permuted in exchanged_names(names):
        known.add(permuted)
        yield f"{description} exchanged", permuted
    if robot is None or set(names) != set(robot.joint_names):
        return
    for description, order in joint_orders(robot).items():
        sides = [(f"{what} exchanged", one) for what, one in exchanged_names(order) if what in _ENDS_OF_ROBOTS]
        for exchanged, permuted in (("", order), *sides):
            if permuted not in known:
                known.add(permuted)
                yield f"columns in {description}" + f" with {exchanged}" * bool(exchanged), permuted


def exchanged_pairs(names: Sequence[str], some: Collection[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The names with any two exchanged, at least one of them in `some`."""
    for one, other in itertools.combinations(names, 2):
        if one in some or other in some:
            yield _with_exchanged(names, one, other)


def _with_exchanged(names: Sequence[str], one: str, other: str) -> tuple[str, tuple[str, ...]]:
    """A description, and the names with two exchanged."""
    partner = {one: other, other: one}
    return f"{one} and {other} exchanged", tuple(partner.get(name, name) for name in names)


def exchanged_in_limbs(names: Sequence[str], robot: Robot | None) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The names with two joints of a limb exchanged: neighbours, or with one joint between them."""
    if robot is None or set(names) != set(robot.joint_names):
        return
    for body in robot.bodies:
        above = body.parent
        apart = 0
        while body.joint is not None and body.joint.name in names and above > 0 and apart < _MOST_APART:
            joint = robot.bodies[above].joint
            if joint is not None and joint.name in names:
                apart += 1
                yield _with_exchanged(names, joint.name, body.joint.name)
            above = robot.bodies[above].parent


#: Largest number of joints that are tried one at a time: those of a hand, or of two arms.
_MAX_SINGLE_JOINTS = 24


#: Fields that can be derived from positions and orientation.
_JOINT_RATES = ("joint_velocity", "joint_acceleration")
_JOINT_MOTION = ("joint_position", *_JOINT_RATES)
_BASE_RATES = ("base_angular_velocity_base", "base_angular_acceleration_base")
#: Vectors along the world's axes.
_WORLD_FIELDS = (
    "base_position_world",
    "base_linear_velocity_world",
    "base_linear_acceleration_world",
    "contact_wrench_world",
)
#: Worlds whose z axis does not point up, and what turns it up: rotation vectors in quarter turns.
_WORLDS = {
    "z axis points down": (2.0, 0.0, 0.0),
    "y axis points up": (1.0, 0.0, 0.0),
    "x axis points up": (0.0, -1.0, 0.0),
}
_OPPOSITE_MOMENTS = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
_MILLI_MOMENT_FACTORS = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])


@dataclass(frozen=True)
class Mistake:
    """A common mistake: its field, a description, advice, and the function that corrects a log.

    `after_filter`: `correct` also works on a filtered log (new names, or a constant linear map of filtered values).
    `of_joint`: it concerns the sign or zero of one joint; the joint's friction can contradict it.
    """

    field: str
    description: str
    advice: str
    correct: Callable[[Log], Log]
    after_filter: bool = False
    of_joint: bool = False


def possible_mistakes(log: Log, robot: Robot | None = None) -> Iterator[Mistake]:
    """The mistakes that this log may contain; joint orders of other programs need the robot."""
    for rates in (_JOINT_RATES, _BASE_RATES):
        given = [field for field in rates if getattr(log, field) is not None]
        if given:
            text = f"{' and '.join(given)} not the derivatives of the positions"
            yield Mistake(given[-1], text, "remove them: torchid then derives them", _remove(given))
    yield Mistake(
        "joint_position", "in degrees", "convert to radians", lambda log: _degrees_to_radians(log, slice(None))
    )
    far = np.flatnonzero(np.abs(log.joint_position).max(axis=0, initial=0.0) > MAX_ANGLE_RAD)
    if 0 < len(far) < len(log.joint_names):
        text = f"{join_names([log.joint_names[joint] for joint in far])} in degrees"
        yield Mistake("joint_position", text, "convert to radians", lambda log: _degrees_to_radians(log, far))
    yield from _order_mistakes(log, robot)
    yield from _orientation_mistakes() if log.base_quat_xyzw is not None else _mountings()
    if log.imu_specific_force is not None:
        advice = "reverse it: it must point up at rest"
        reverse = _multiply("imu_specific_force", -1.0)
        yield Mistake("imu_specific_force", "reversed (gravity minus acceleration)", advice, reverse, True)
        yield from accelerometer_axes(log, robot)
    if log.joint_torque is not None:
        for description, permuted in other_orders(log.joint_names, robot):  # of limbs, or of drives
            order = [permuted.index(name) for name in log.joint_names]
            advice = "give torques in the order of joint_names"
            yield Mistake("joint_torque", description, advice, _reorder(("joint_torque",), order), True)
    if log.base_position_world is not None:
        yield from _unit_mistakes("base_position_world", "length")
    for field, other in (WRENCHES, WRENCHES[::-1]):
        if getattr(log, field) is not None:
            yield from _wrench_mistakes(field, other)


def accelerometer_axes(log: Log, robot: Robot | None) -> Iterator[Mistake]:
    """Readings of an accelerometer on the base, given along the world's axes."""
    if log.imu_specific_force is None or log.base_quat_xyzw is None or robot is None:
        return
    body, T_base_imu = robot.links.get(log.imu_frame, (1, np.eye(4)))

    def along_imu(log: Log) -> dict[str, Any]:
        in_base = rotate_to_base(np.asarray(log.base_quat_xyzw), np.asarray(log.imu_specific_force))
        return {"imu_specific_force": in_base @ T_base_imu[:3, :3]}

    if body == 0:
        advice = "give the reading of the accelerometer along the axes of imu_frame"
        yield Mistake("imu_specific_force", "along the world's axes", advice, _change(along_imu))


def _orientation_mistakes() -> Iterator[Mistake]:
    """Orientations in other worlds, or in other conventions than xyzw from base to a world with z up."""
    up = "rotate positions, orientations and vectors so that z points up"
    for axis_points, quarters in _WORLDS.items():
        turned_up = _turn_world(Rotation.from_rotvec(0.5 * np.pi * np.array(quarters)))
        yield Mistake("base_quat_xyzw", f"in a world whose {axis_points}", up, turned_up)
    yield Mistake("base_quat_xyzw", *QUATERNION_ORDER, _with_quaternions(lambda quat: np.roll(quat, -1, axis=1)))
    yield Mistake("base_quat_xyzw", *QUATERNION_ORDER, _with_quaternions(lambda quat: np.roll(quat, 1, axis=1)))
    yield Mistake("base_quat_xyzw", *INVERSE_QUATERNION, _with_quaternions(inverse_rotation))
    downward = "of a base whose z axis points down"  # standing feet cannot tell whether the world's z axis does, too
    forward = "rotate the base to x forward, y left, z up; rotate the world too if its z axis points down (PX4)"
    turn_world = _turn_world(Rotation.from_rotvec([np.pi, 0.0, 0.0]))
    yield Mistake("base_quat_xyzw", downward, forward, _turn_base)
    yield Mistake("base_quat_xyzw", downward, forward, lambda log: _turn_base(turn_world(log)))
    for axis, name in enumerate("xyz"):
        mirrored = f"in a left-handed world: its {name} axis is reversed"
        turn = "convert orientations and vectors to a right-handed world"
        yield Mistake("base_quat_xyzw", mirrored, turn, _mirror_world(axis))


def _mountings() -> Iterator[Mistake]:
    """Fixed bases on a ceiling or a wall; without an orientation in the log they are assumed upright."""
    for place, *turns in (("ceiling", (2, 0)), ("wall", (1, 0), (-1, 0), (0, 1), (0, -1))):
        for x, y in 0.5 * np.pi * np.array(turns):
            quat = np.array([np.sin(0.5 * x), np.sin(0.5 * y), 0.0, np.cos(0.5 * x) * np.cos(0.5 * y)])
            advice = f"set robot.base_tilt: [{x:.4f}, {y:.4f}] (about the base link's x and y axes)"
            yield Mistake("base", f"mounted on a {place}", advice, _constant("base_quat_xyzw", quat))


def reversed_joints(log: Log) -> Iterator[Mistake]:
    """Joints whose position is reversed, one at a time: many logs to try."""
    for joint, name in enumerate(log.joint_names):
        advice = f"set logs.columns.joint_position.scale: {{{name}: -1}}; for velocity and torque, too, if reversed"
        yield Mistake("joint_position", f"{name} reversed", advice, _reverse_joint(joint))


def _reverse_joint(joint: int) -> Callable[[Log], Log]:
    def correct(log: Log) -> Log:
        position = log.joint_position.copy()
        position[:, joint] *= -1.0
        return dataclasses.replace(_remove(_JOINT_RATES)(log), joint_position=position)

    return correct


def joint_mistakes(log: Log) -> Iterator[Mistake]:
    """Single joints of an arm or a hand with a reversed sign, or a zero off by a right angle."""
    if len(log.joint_names) > _MAX_SINGLE_JOINTS:
        return
    for joint, name in enumerate(log.joint_names):
        flip = f"set logs.columns.joint_position.scale: {{{name}: -1}}; for velocity and acceleration, too"
        both = (*_JOINT_MOTION, "joint_torque")
        yield Mistake("joint_position", f"{name} reversed", flip, _flip_joint(joint, _JOINT_MOTION), True, True)
        text = f"{name} reversed, with its torque"
        yield Mistake("joint_position", text, f"{flip}, and for torque", _flip_joint(joint, both), True, True)
        for degrees in (90, -90, 180):
            text = f"{name} has another zero"
            advice = f"add {degrees} degrees to its positions"
            yield Mistake("joint_position", text, advice, _shift_joint(joint, np.radians(degrees)), True, True)


def _flip_joint(joint: int, fields: Sequence[str]) -> Callable[[Log], Log]:
    def correct(log: Log) -> Log:
        flipped = {name: x.copy() for name in fields if (x := getattr(log, name)) is not None}
        for x in flipped.values():
            x[:, joint] *= -1.0
        return dataclasses.replace(log, **flipped)

    return correct


def _shift_joint(joint: int, angle: float) -> Callable[[Log], Log]:
    def correct(log: Log) -> Log:
        position = log.joint_position.copy()
        position[:, joint] += angle
        return dataclasses.replace(log, joint_position=position)

    return correct


def exchanged_joints(names: Sequence[str], some: Collection[str]) -> Iterator[Mistake]:
    """Names of any two joints exchanged, at least one of them in `some`: many logs to try."""
    for text, permuted in exchanged_pairs(names, some):
        yield _misnamed_joints(text, permuted)


def _misnamed_joints(text: str, permuted: tuple[str, ...]) -> Mistake:
    """Wrong joint names: the true names of the columns are `permuted`."""
    advice = "give joint_names in the order of the columns; for arrays without names set logs.columns.joint_order: "
    advice += f"[{', '.join(permuted)}]"
    return Mistake("joint_names", text, advice, _rename("joint_names", permuted), True)


def _order_mistakes(log: Log, robot: Robot | None) -> Iterator[Mistake]:
    """Exchanged names of joints and contacts, and flags assigned to the wrong contacts."""
    for text, permuted in (*exchanged_in_limbs(log.joint_names, robot), *other_orders(log.joint_names, robot)):
        yield _misnamed_joints(text, permuted)
    for description, permuted in exchanged_names(log.contact_names, shortest=1):
        order = [permuted.index(name) for name in log.contact_names]
        text = f"{description} exchanged"
        advice = "give contact_names in the order of the columns"
        yield Mistake("contact_names", text, advice, _rename("contact_names", permuted), True)
        flags = _reorder(("contact_active",), order)
        yield Mistake("contact_active", text, "give the flags in the order of contact_names", flags)


def _unit_mistakes(field: str, quantity: str, after_filter: bool = False) -> Iterator[Mistake]:
    for units, factor in other_units(quantity).items():
        advice = f"{advise_units({field: tuple(units.split(' or '))})}, or multiply by {factor:.4g}"
        yield Mistake(field, f"in {units}", advice, _multiply(field, factor), after_filter)


def quarter_turns() -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Mountings of a sensor rotated by right angles: the frame's components in words, and their matrix (3, 3)."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.diag(signs) @ np.eye(3)[list(order)]
            if np.linalg.det(R) > 0.0 and not np.array_equal(R, np.eye(3)):
                axes = ("-" * (sign < 0.0) + "xyz"[axis] for sign, axis in zip(signs, order, strict=True))
                yield f"x, y, z are {', '.join(axes)} of the readings", R


def _turn_wrench(field: str, R: NDArray[np.float64]) -> Callable[[Log], Log]:
    both = np.kron(np.eye(2), R)
    return _change(lambda log: {field: getattr(log, field) @ both.T})


def _wrench_mistakes(field: str, other: str) -> Iterator[Mistake]:
    moments = _change(lambda log: {field: getattr(log, field) * _MILLI_MOMENT_FACTORS})
    yield Mistake(field, "moments in N mm", "multiply moments by 0.001", moments, True)
    opposite = _change(lambda log: {field: getattr(log, field) * _OPPOSITE_MOMENTS})
    yield Mistake(field, "moments reversed", "reverse the moments: give what the ground exerts", opposite, True)
    first = _change(lambda log: {field: np.roll(getattr(log, field), 3, axis=2)})
    yield Mistake(field, "with the moment first", "give the force first, then the moment", first, True)
    axes = "along the world's axes" if other == WRENCHES[1] else "along the contact frames' axes"
    moved = _change(lambda log: {other: getattr(log, field), field: None, "moments_about_world_origin": False})
    yield Mistake(field, axes, f"rename it to {other}", moved, True)
    if field == WRENCHES[0]:
        for axes, R in quarter_turns():
            turn = f"rotate forces and moments into the contact frames: their {axes}"
            yield Mistake(field, "along axes rotated by right angles", turn, _turn_wrench(field, R), True)


def _turn_world(turn: Rotation) -> Callable[[Log], Log]:
    """A log in a rotated world frame."""
    R = turn.as_matrix()
    x, y, z, w = turn.as_quat()
    times_quaternion = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])

    def correct(log: Log) -> Log:
        fields: dict[str, Any] = {}
        if log.base_quat_xyzw is not None:
            fields["base_quat_xyzw"] = log.base_quat_xyzw @ times_quaternion.T
        for name in _WORLD_FIELDS:
            if (vectors := getattr(log, name)) is not None:
                fields[name] = vectors @ np.kron(np.eye(vectors.shape[-1] // 3), R).T
        return dataclasses.replace(log, **fields)

    return correct


def _turn_base(log: Log) -> Log:
    """A log with base axes rotated by half a turn about x."""
    half_turn = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    return _with_quaternions(lambda quat: (Rotation.from_quat(quat) * half_turn).as_quat())(log)


def _mirror_world(axis: int) -> Callable[[Log], Log]:
    """A log with one axis of the world and of the base reversed; this reverses two components of the quaternion."""
    signs = np.ones(3)
    signs[axis] = -1.0

    def correct(log: Log) -> Log:
        fields: dict[str, Any] = dict.fromkeys(_BASE_RATES)
        if log.base_quat_xyzw is not None:
            fields["base_quat_xyzw"] = log.base_quat_xyzw * np.append(-signs, 1.0)
        for name in _WORLD_FIELDS[:-1]:
            if (vectors := getattr(log, name)) is not None:
                fields[name] = vectors * signs
        if (wrench := log.contact_wrench_world) is not None:
            fields["contact_wrench_world"] = wrench * np.append(signs, -signs)
        return dataclasses.replace(log, **fields)

    return correct


def _change(fields: Callable[[Log], dict[str, Any]]) -> Callable[[Log], Log]:
    return lambda log: dataclasses.replace(log, **fields(log))


def _remove(fields: Sequence[str]) -> Callable[[Log], Log]:
    return _change(lambda _: dict.fromkeys(fields))


def _multiply(field: str, factor: float) -> Callable[[Log], Log]:
    return _change(lambda log: {field: factor * getattr(log, field)})


def _constant(field: str, value: FloatArray) -> Callable[[Log], Log]:
    return _change(lambda log: {field: np.tile(value, (len(log), 1))})


def _degrees_to_radians(log: Log, joints: slice | NDArray[np.intp]) -> Log:
    """The log with joints in radians; velocities and accelerations are derived again, right or not."""
    position = log.joint_position.copy()
    position[:, joints] = np.radians(position[:, joints])
    return dataclasses.replace(_remove(_JOINT_RATES)(log), joint_position=position)


def _with_quaternions(change: Callable[[Any], Any]) -> Callable[[Log], Log]:
    rates = dict.fromkeys(_BASE_RATES)
    return _change(lambda log: {"base_quat_xyzw": make_sign_continuous(change(log.base_quat_xyzw)), **rates})


def _rename(field: str, names: tuple[str, ...]) -> Callable[[Log], Log]:
    return _change(lambda _: {field: names})


def _reorder(fields: Sequence[str], order: list[int]) -> Callable[[Log], Log]:
    return _change(lambda log: {field: getattr(log, field)[:, order] for field in fields})
