"""Errors by group of rows: those of the series that they summarize."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import value
from random_samples import random_samples
from scipy.linalg import null_space
from synthetic import G1, TALOS_FULL, Array, Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.problem import RowBuilder, Samples, bind_log
from torchid.problem.metrics import Evaluation, force_series
from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("fixed_base", [False, True], ids=["floating", "bolted"])
def test_errors_by_group_are_those_of_the_series(tmp_path: Path, fixed_base: bool) -> None:
    """Projected ones are as long as the part of the error that no contact force and no wrench in a limb enters."""
    robot, rng = load(machine(tmp_path), None, fixed_base, SENSORS), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    contacts = [(contact.frame, contact.components) for contact in CONTACTS]
    samples = bind_log(make_log(oracle, contacts, STATES, 24, rng), robot, CONTACTS)
    evaluation, phi, base = Evaluation(robot, CONTACTS), robot.nominal.reshape(1, -1), robot.base_rows
    (found,) = evaluation.metrics([samples], phi)
    measured, (predicted,) = force_series(evaluation.builder, samples, phi)
    off, joints = predicted - measured, slice(base, robot.nv)
    torque = np.hstack([np.zeros((24, base)), value(samples.torque).numpy()])
    limbs, limbs_measured = (x[:, robot.nv :].reshape(24, -1, 2, 3) for x in (off, measured))
    for k, group in enumerate(("ft_force", "ft_moment")):
        assert found.rms[group] == pytest.approx(rms(limbs[:, :, k]), rel=1e-12)
        assert found.relative[group] == pytest.approx(rms(limbs[:, :, k]) / rms(limbs_measured[:, :, k]), rel=1e-12)
    expected = {"joint_torque": (np.mean([rms(x) for x in off[:, joints].T]), 1e-12)}
    if base:
        expected |= {"base_force": (rms(off[:, :3]), 1e-12), "base_moment": (rms(off[:, 3:6]), 1e-12)}
    q = replace(samples, wrench=None).coordinates()[0].numpy()
    J = [oracle.jacobian(q, contact.frame)[:, list(contact.components)] for contact in CONTACTS]
    unmeasured, inside = np.eye(robot.n_rows)[robot.nv :], []
    for i, active in enumerate(samples.active.tolist()):
        rows = [one[i] for one, touches in zip(J, active, strict=True) if touches]
        V = null_space(np.concatenate([unmeasured, *rows]), rcond=1e-9)
        inside.append(V.T @ (predicted - torque)[i])
    expected["nullspace"] = (rms(np.concatenate(inside)), 1e-9)
    for group, (size, accuracy) in expected.items():
        assert found.rms[group] == pytest.approx(size, rel=accuracy), group
    vectors = {group: (limbs[:, :, k], limbs_measured[:, :, k]) for k, group in enumerate(("ft_force", "ft_moment"))}
    if base:
        vectors |= {"base_force": (off[:, :3], measured[:, :3]), "base_moment": (off[:, 3:6], measured[:, 3:6])}
    axes = [name for name in found.part_rms if not name.startswith("joint_torque.")]
    assert sorted(axes) == sorted(f"{group}.{axis}" for group in vectors for axis in "xyz")
    for group, (error, size) in vectors.items():
        for axis, name in enumerate("xyz"):
            assert found.part_rms[f"{group}.{name}"] == pytest.approx(rms(error[..., axis]), rel=1e-12)
            share = rms(error[..., axis]) / rms(size[..., axis])
            assert found.part_relative[f"{group}.{name}"] == pytest.approx(share, rel=1e-12)
            assert found.as_dict()[f"{group}_rms_by_axis"][name] == found.part_rms[f"{group}.{name}"]
    if base:
        about_mean = rms(measured[:, :3] - measured[:, :3].mean(axis=0))
        assert found.base_force_of_variation == pytest.approx(rms(off[:, :3]) / about_mean, rel=1e-12)
    assert list(found.by_joint_rms.values()) == pytest.approx([rms(x) for x in off[:, joints].T], rel=1e-12)
    micro = replace(samples, torque=1e-6 * value(samples.torque), wrench=1e-6 * value(samples.wrench))
    (small,) = evaluation.metrics([micro], 1e-6 * phi)
    for group, share in found.relative.items():
        assert small.relative[group] == (share if share is None else pytest.approx(share, rel=1e-9)), "has no unit"


def test_joint_torques_are_said_to_be_of_limbs_in_the_air_only_where_no_others_count(tmp_path: Path) -> None:
    """Without wrenches a limb that touches is left out of the series of which the errors are."""
    robot, rng = load(machine(tmp_path), None, False, SENSORS), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    contacts = [(contact.frame, contact.components) for contact in CONTACTS]
    log = make_log(oracle, contacts, STATES, 24, rng)
    evaluation, phi = Evaluation(robot, CONTACTS), 1.1 * robot.nominal.reshape(1, -1)
    labels = {}
    for name, wrench in (("all", log.contact_wrench_local), ("none", None)):
        samples = bind_log(replace(log, contact_wrench_local=wrench), robot, CONTACTS)
        (found,) = evaluation.metrics([samples], phi)
        measured, (predicted,) = force_series(evaluation.builder, samples, phi)
        off = (predicted - measured)[:, robot.base_rows : robot.nv]
        known = [rms(x[np.isfinite(x)]) for x in off.T if np.isfinite(x).any()]
        assert found.rms["joint_torque"] == pytest.approx(np.mean(known), rel=1e-12)
        labels[name] = found.label("joint_torque")
        assert found.label("base_force") == "base force [N]"
    flying = replace(log, contact_wrench_local=None, contact_active=np.zeros((24, len(CONTACTS)), dtype=bool))
    (in_flight,) = evaluation.metrics([bind_log(flying, robot, CONTACTS)], phi)
    labels["flight"] = in_flight.label("joint_torque")
    assert labels == {
        "all": "joint torque [N m]",
        "none": "joint torque, limbs in the air [N m]",
        "flight": "joint torque [N m]",
    }


SOLES = [Contact("left_sole_link", "flat"), Contact("right_sole_link", "line")]


def local_wrenches(robot: Robot, contacts: Sequence[Contact], samples: Samples) -> torch.Tensor:
    """Wrenches (B, C, 6) along the contact frames' axes, turned by pytorch-kinematics' poses."""
    assert samples.wrench is not None
    if not samples.wrench_in_world:
        return samples.wrench
    poses = robot.link_poses(samples.joint_position)
    R = torch.stack([samples.base.rotation @ poses[c.frame][:, :3, :3] for c in contacts], dim=1)
    return (samples.wrench.unflatten(2, (2, 3)) @ R).flatten(2)


@pytest.mark.parametrize("world", [False, True], ids=["local", "world"])
def test_evaluation_measures_and_predicts_what_the_plain_path_does(world: bool) -> None:
    robot, rng = load(TALOS_FULL), np.random.default_rng(4)
    samples, state = random_samples(robot, SOLES, 40, rng, world)
    builder = RowBuilder(robot, SOLES, named_sensors("full", robot.n, len(SOLES)))
    phi = rng.normal(size=(3, robot.nominal.size))
    phi.reshape(3, -1, 12)[:, 0, 10:] = 0.0  # the base has no joint
    measured, predicted = force_series(builder, samples, phi)
    q, v, a = map(torch.from_numpy, state)
    expected = torch.nn.functional.pad(samples.torque, (6, 0))
    wrench = local_wrenches(robot, SOLES, samples)
    for place, contact in enumerate(SOLES):
        used = list(contact.components)
        pushing = (wrench[:, place] * samples.active[:, place, None])[:, used]
        expected += (FrameJacobian(robot, contact.frame)(q)[:, used].mT @ pushing[..., None])[..., 0]
    np.testing.assert_allclose(measured, expected, rtol=0.0, atol=1e-13 * float(expected.abs().max()))
    K = Regressor(robot)(q, v, a).numpy()
    expected_forces = np.einsum("bip,mp->mbi", K, phi)
    np.testing.assert_allclose(predicted, expected_forces, rtol=0.0, atol=1e-13 * np.abs(expected_forces).max())


def test_an_unmeasured_wrench_leaves_the_joints_that_it_does_not_load_measured() -> None:
    robot = load(G1)
    contacts = [Contact("left_ankle_roll_link", "flat"), Contact("right_ankle_roll_link", "flat")]
    samples, _ = random_samples(robot, contacts, 40, 6)
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, 2))
    known, _ = force_series(builder, samples, robot.nominal.reshape(1, -1))
    samples.wrench[:, 0] = torch.nan
    measured, _ = force_series(builder, samples, robot.nominal.reshape(1, -1))
    leg = [f"left_{part}_joint" for part in ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")]
    loaded = np.concatenate([np.ones(6, bool), np.isin(robot.joint_names, leg)])
    on_ground = samples.active[:, 0].numpy()
    assert np.isnan(measured[np.ix_(on_ground, loaded)]).all()
    np.testing.assert_array_equal(measured[on_ground][:, ~loaded], known[on_ground][:, ~loaded])
    np.testing.assert_array_equal(measured[~on_ground], known[~on_ground])
