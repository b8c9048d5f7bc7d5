"""Errors by group of rows: those of the series that they summarize."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motions import value
from scipy.linalg import null_space
from synthetic import Array, Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.problem import bind_log
from torchid.problem.metrics import Evaluation, force_series


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
        assert found.limb_rms[group] == pytest.approx(rms(limbs[:, :, k]), rel=1e-12)
        assert found.limb_relative[group] == pytest.approx(
            rms(limbs[:, :, k]) / rms(limbs_measured[:, :, k]), rel=1e-12
        )
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
    assert found.by_axis_rms.keys() == found.by_axis_relative.keys() == vectors.keys()
    for group, (error, size) in vectors.items():
        for axis, name in enumerate("xyz"):
            assert found.by_axis_rms[group][name] == pytest.approx(rms(error[..., axis]), rel=1e-12)
            share = rms(error[..., axis]) / rms(size[..., axis])
            assert found.by_axis_relative[group][name] == pytest.approx(share, rel=1e-12)
            assert found.as_dict()[f"{group}_rms_by_axis"] == found.by_axis_rms[group]
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
