"""What an MJCF robot must not have: whatever exerts forces that the equations of a tree of joints do not have."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from torchid.errors import UrdfError, warn
from torchid.guards import MAX_NUMBER
from torchid.parameters import GRAVITY, Array
from torchid.robot.mjcf_model import MjcfModel, mujoco, pose

LOOPS = {"connect": "point", "weld": "weld"}
"""Type of the loop that an equality constraint closes, by its tag."""

_CLOSE = 0.02  # m/s^2: 9.8 and 9.81 are the same planet


def check_model(model: MjcfModel) -> None:
    """Refuse what makes forces on the robot's bodies beside gravity, joints' friction, armatures and springs.

    Raises:
        UrdfError: names the element and its line.

    Warns:
        TorchidWarning: the model's gravity is not the Earth's, which is used.
    """
    spec, members = model.spec, {model.bodies[i] for i in model.members}
    for element in model.text.root.iter("inertial"):  # MuJoCo takes a NaN for an attribute that is not there
        if any(word.lower().lstrip("+-") in ("nan", "inf") for x in element.attrib.values() for word in x.split()):
            field = f"<inertial>, line {element.sourceline}"
            raise UrdfError(model.path, field, "a number that is not finite", "finite numbers")
    for body in spec.bodies:
        if body.id in model.members:
            _check_body(model, body)
    for flex in spec.flexes:
        model.refuse(flex, "flex", flex.name, "a flexible body", "rigid bodies")
    for equality in spec.equalities:
        if equality.active and _touches(model, equality, members) and mimic_of(model, equality) is None:
            _check_equality(model, equality)
    _check_transmissions(model)
    _check_medium(model)


def _check_equality(model: MjcfModel, equality: Any) -> None:
    """Refuse all but closed loops, and what attaches the robot to something else."""
    kind = equality_kind(equality)
    if kind not in LOOPS:
        linear = {"joint": "joint1 = c0 + c1 joint2 alone", "tendon": "one fixed tendon of two joints"}
        accepted = linear.get(kind, "connect, weld, or a linear joint")
        model.refuse(equality, kind, equality.name, "an equality constraint", accepted)


def _check_body(model: MjcfModel, body: Any) -> None:
    if body.gravcomp:
        model.refuse(body, "body", body.name, f"gravcomp {body.gravcomp:g}", "gravcomp 0")
    if body.plugin.active:
        model.refuse(body, "body", body.name, "a plugin, which may exert forces", "none")
    for joint in body.joints:
        _check_joint(model, joint)
        if joint.type.name == "mjJNT_FREE":
            _check_free_joint(model, joint)


def _check_joint(model: MjcfModel, joint: Any) -> None:
    if joint.type.name == "mjJNT_BALL":
        accepted = "joints of type hinge or slide: three hinges in place of a ball"
        model.refuse(joint, "joint", joint.name, "type ball", accepted)
    values = {name: np.atleast_1d(getattr(joint, name)) for name in ("damping", "stiffness")}
    for name, value in values.items():
        if value[1:].any():
            model.refuse(joint, "joint", joint.name, f"{name} {_numbers(value)}", "one number")
        if np.abs(value).max() > MAX_NUMBER:
            accepted = f"at most {MAX_NUMBER:g}: no joint, if it cannot move"
            model.refuse(joint, "joint", joint.name, f"{name} {_numbers(value)}", accepted)


def _check_free_joint(model: MjcfModel, joint: Any) -> None:
    for name in ("armature", "damping", "frictionloss", "stiffness"):
        value = np.atleast_1d(getattr(joint, name))
        if value.any():
            found = f"{name} {_numbers(value)} of a free joint"
            model.refuse(joint, "joint", joint.name, found, f"{name} 0, or <freejoint/>")


def _check_transmissions(model: MjcfModel) -> None:
    """Refuse tendons and actuators that exert forces or have inertia by themselves; limits are as those of joints."""
    for tendon in model.spec.tendons:
        for name in ("stiffness", "damping", "frictionloss", "armature"):
            if np.any(getattr(tendon, name)):
                tag = _tendon_tag(model.model, tendon.id)
                accepted = "tendons without stiffness, damping, frictionloss and armature"
                model.refuse(tendon, tag, tendon.name, f"a tendon with {name}", accepted)
    for actuator in model.spec.actuators:
        for name in ("armature", "damping"):
            if np.any(getattr(actuator, name, 0.0)):  # MuJoCo has them since 3.5
                accepted = f"{name} of the joint, or none"
                model.refuse(
                    actuator, _actuator_tag(model, actuator), actuator.name, f"{name} of an actuator", accepted
                )


def _check_medium(model: MjcfModel) -> None:
    option = model.model.opt
    for name in ("density", "viscosity"):
        if getattr(option, name):
            element = next((x for x in model.text.root.iter("option") if x.get(name)), None)
            line = "" if element is None else f", line {element.sourceline}"
            raise UrdfError(model.path, f"<option>{line}", f"{name} {getattr(option, name):g}", f"{name} 0: no fluid")
    off = option.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = np.zeros(3) if off else option.gravity
    if np.abs(gravity - [0.0, 0.0, -GRAVITY]).max() > _CLOSE:
        warn(f"{model.path}: gravity {_numbers(gravity)}; the Earth's along -z is used")


def mimic_of(model: MjcfModel, equality: Any) -> tuple[str, str, float, float] | None:
    """Follower, master, multiplier and offset [rad or m] of two joints that an equality couples linearly; else None.

    MuJoCo's polynomial is of deviations from the joints' reference positions.
    """
    if equality_kind(equality) == "tendon" and equality.active:
        return _mimic_of_tendon(model, equality)
    if equality_kind(equality) != "joint" or not (equality.active and equality.name1 and equality.name2):
        return None
    c0, c1, *rest = equality.data[:5]
    if any(rest) or not c1:
        return None
    follower, master = (model.model.joint(name) for name in (equality.name1, equality.name2))
    reference = [float(model.model.qpos0[int(joint.qposadr[0])]) for joint in (follower, master)]
    return equality.name1, equality.name2, float(c1), float(c0 + reference[0] - c1 * reference[1])


def _mimic_of_tendon(model: MjcfModel, equality: Any) -> tuple[str, str, float, float] | None:
    """As `mimic_of`, of the two joints of a fixed tendon of constant length; the second follows the first."""
    of, tendon = model.model, int(model.model.eq_obj1id[equality.id])
    wraps = slice(int(of.tendon_adr[tendon]), int(of.tendon_adr[tendon] + of.tendon_num[tendon]))
    if equality.name2 or list(of.wrap_type[wraps]) != [int(mujoco.mjtWrap.mjWRAP_JOINT)] * 2:
        return None
    (master, follower), (a, b) = map(int, of.wrap_objid[wraps]), map(float, of.wrap_prm[wraps])
    if not b:
        return None
    start, end = (float(of.qpos0[int(of.jnt_qposadr[joint])]) for joint in (master, follower))
    return model.joints[follower], model.joints[master], -a / b, end + (float(equality.data[0]) + a * start) / b


def _touches(model: MjcfModel, equality: Any, members: set[str]) -> bool:
    """Whether an equality constraint is on a body or joint of the robot, or on what is neither."""
    names = [name for name in (equality.name1, equality.name2) if name]
    kind = equality.objtype.name.removeprefix("mjOBJ_").lower()
    if equality_kind(equality) == "joint":
        on = {model.bodies[int(model.model.jnt_bodyid[i])] for i, name in enumerate(model.joints) if name in names}
    elif kind == "body":
        on = set(names)
    elif kind == "site":
        on = {model.bodies[int(model.model.site(name).bodyid[0])] for name in names}
    else:
        return True
    return bool(on & members)


def is_held(model: MjcfModel, equality: Any) -> bool:
    """Whether an equality constraint is active and holds a body of the robot to another body, of the robot or not."""
    if not equality.active or equality_kind(equality) not in LOOPS:
        return False
    return not {*model.members}.isdisjoint(loop_bodies(model, equality))


def loop_bodies(model: MjcfModel, equality: Any) -> tuple[int, int]:
    """Numbers of both bodies that a `connect` or `weld` keeps together."""
    of, sites = model.model, equality.objtype.name == "mjOBJ_SITE"
    one, other = int(of.eq_obj1id[equality.id]), int(of.eq_obj2id[equality.id])
    return (int(of.site_bodyid[one]), int(of.site_bodyid[other])) if sites else (one, other)


def loop_frames(model: MjcfModel, equality: Any) -> tuple[Array, Array]:
    """Poses (4, 4) [m], in their bodies, of both frames that a `connect` or `weld` keeps together.

    As `mj_instantiateEqual` has them: of bodies, the anchor of a connect in the first and in the second, and that of a
    weld in the second and in the first, with the second body's orientation in the first.
    """
    of, data = model.model, model.model.eq_data[equality.id]
    if equality.objtype.name == "mjOBJ_SITE":
        sites = (int(x[equality.id]) for x in (of.eq_obj1id, of.eq_obj2id))
        one, other = (pose(of.site_pos[site], of.site_quat[site]) for site in sites)
        return one, other
    level = np.array([1.0, 0.0, 0.0, 0.0])
    if equality_kind(equality) == "connect":
        return pose(data[:3], level), pose(data[3:6], level)
    return pose(data[3:6], data[6:10]), pose(data[:3], level)


def driven_joints(model: MjcfModel) -> set[str] | None:
    """Names of the joints that actuators drive; None where some drive what is no joint, or there are none."""
    of, driven, kinds = model.model, set[int](), mujoco.mjtTrn
    for kind, (target, _) in zip(of.actuator_trntype, of.actuator_trnid, strict=True):
        if int(kind) in map(int, (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT)):
            driven.add(int(target))
        elif int(kind) == int(kinds.mjTRN_TENDON):
            first, count = int(of.tendon_adr[target]), int(of.tendon_num[target])
            if (of.wrap_type[first : first + count] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
                return None
            driven.update(map(int, of.wrap_objid[first : first + count]))
        else:
            return None
    return {model.joints[joint] for joint in driven} or None


def equality_kind(equality: Any) -> str:
    """Tag of an equality constraint."""
    return str(equality.type.name).removeprefix("mjEQ_").lower()


def _tendon_tag(model: mujoco.MjModel, tendon: int) -> str:
    """Tag of a tendon, by its number."""
    first = int(model.wrap_type[model.tendon_adr[tendon]])
    return "fixed" if first == int(mujoco.mjtWrap.mjWRAP_JOINT) else "spatial"


def _actuator_tag(model: MjcfModel, actuator: Any) -> str:
    """Tag of an actuator, by its name."""
    found = _actuators(model, actuator.name)
    return next(found, "actuator")


def _actuators(model: MjcfModel, name: str) -> Iterator[str]:
    for section in model.text.root.iter("actuator"):
        yield from (str(element.tag) for element in section if element.get("name", "") == name)


def _numbers(values: Any) -> str:
    return " ".join(f"{x:g}" for x in np.atleast_1d(values))
