"""Inverse dynamics of MuJoCo, in this project's conventions."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import Array

from torchid.robot import Robot

IS_MUJOCO_3 = mujoco.__version__.startswith("3.")
INERTIA_ROUNDING = 1e-6 if IS_MUJOCO_3 else 0.0
"""Share of an inertia, in addition to that of double precision: MuJoCo 3 iterates less for the principal axes."""


def mujoco_model(path: Path, robot: Robot) -> mujoco.MjModel:
    """A URDF as MuJoCo reads it, in free flight unless the base is fixed, without contacts and soft constraints."""
    root = ElementTree.parse(path).getroot()
    if not robot.fixed_base:
        ElementTree.SubElement(root, "link", name="the ground")
        flight = ElementTree.SubElement(root, "joint", name="free flight", type="floating")
        ElementTree.SubElement(flight, "parent", link="the ground")
        ElementTree.SubElement(flight, "child", link=robot.base_link)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model


def joint_addresses(model: mujoco.MjModel, robot: Robot) -> tuple[Array, Array]:
    """Where MuJoCo keeps positions and velocities of the robot's joints."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in robot.joint_names]
    return model.jnt_qposadr[ids], model.jnt_dofadr[ids]


def mujoco_forces(model: mujoco.MjModel, robot: Robot, q: Array, v: Array, a: Array) -> Array:
    """Generalized forces (B, nv); Coulomb friction, a soft constraint in MuJoCo, is added as it reads it."""
    data, base, expected = mujoco.MjData(model), robot.base_rows, []
    joint_q, joint_v = joint_addresses(model, robot)
    for q_, v_, a_ in zip(q, v, a, strict=True):
        data.qpos[joint_q] = q_[7 if base else 0 :]
        data.qvel[joint_v], data.qacc[joint_v] = v_[base:], a_[base:]
        R = np.eye(3)
        if base:  # MuJoCo: linear parts along world axes, angular along the body's, quaternion w x y z
            R = Rotation.from_quat(q_[3:7]).as_matrix()
            data.qpos[:7] = [*q_[:3], q_[6], *q_[3:6]]
            data.qvel[:6] = [*(R @ v_[:3]), *v_[3:6]]
            data.qacc[:6] = [*(R @ (a_[:3] + np.cross(v_[3:6], v_[:3]))), *a_[3:6]]
        mujoco.mj_inverse(model, data)
        force = data.qfrc_inverse
        joints = force[joint_v] + model.dof_frictionloss[joint_v] * np.sign(v_[base:])
        expected.append([*(R.T @ force[:3]), *force[3:6], *joints] if base else joints)
    return np.array(expected)
