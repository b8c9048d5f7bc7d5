"""The fast path's rows against the plain one: dense regressor, frame Jacobians and the projection's null space.

Rows of many robots against Pinocchio are in test_rows_against_oracle.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_samples import NOISE, random_samples, sensor_set
from synthetic import G1, Array, load

from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.metrics import force_series
from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot
from torchid.sensing import Contact, Projection, SensorSet, named_sensors

State = tuple[Array, Array, Array]


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two legs and a tail that mimics a hip; five frames on the left foot, one on the right and on the tail, turned."""
    inertia = '<inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/>'
    inertial = f'<inertial><origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/><mass value="2"/>{inertia}</inertial>'
    elements = [f'<link name="trunk">{inertial}</link>']

    def add(link: str, parent: str, kind: str, pose: str, rest: str = "") -> None:
        body = "" if kind == "fixed" else inertial
        ends = f'<parent link="{parent}"/><child link="{link}"/>{rest}'
        elements.append(f'<link name="{link}">{body}</link>')
        elements.append(f'<joint name="{link}_joint" type="{kind}"><origin {pose}/>{ends}</joint>')

    for side, y in (("left", 0.2), ("right", -0.2)):
        pose = 'xyz="0.05 {y} -0.3" rpy="0.2 -0.1 0.3"'
        add(f"{side}_hip", "trunk", "revolute", pose.format(y=y), '<axis xyz="1 0.3 0"/>')
        add(f"{side}_knee", f"{side}_hip", "revolute", pose.format(y=0.1), '<axis xyz="0.1 1 0"/>')
        add(f"{side}_foot", f"{side}_knee", "prismatic", pose.format(y=0.0), '<axis xyz="0 0.2 1"/>')
    mimic = '<axis xyz="0 1 1"/><mimic joint="left_hip_joint" multiplier="-1.3" offset="0.2"/>'
    add("tail", "trunk", "revolute", 'xyz="-0.3 0 0.1" rpy="0.1 0.2 0"', mimic)
    for corner, (x, y) in enumerate([(0.1, 0.05), (0.1, -0.05), (-0.1, 0.05), (-0.1, -0.05)]):
        add(f"corner_{corner}", "left_foot", "fixed", f'xyz="{x} {y} -0.03" rpy="0.{corner} -0.2 0.7"')
    add("left_sole", "left_foot", "fixed", 'xyz="0.02 0.01 -0.03" rpy="0.5 0.6 -0.4"')
    add("right_sole", "right_foot", "fixed", 'xyz="0.02 -0.01 -0.03" rpy="-0.3 0.2 1.4"')
    add("tail_tip", "tail", "fixed", 'xyz="-0.4 0 0.1" rpy="1.0 0.1 0.2"')
    path = tmp_path_factory.mktemp("walker") / "walker.urdf"
    path.write_text(f'<robot name="walker">{"".join(elements)}</robot>')
    return path


loaded = cache(lambda urdf, fixed_base: load(urdf, fixed_base=fixed_base))


def local_wrenches(robot: Robot, contacts: Sequence[Contact], samples: Samples) -> torch.Tensor:
    """Wrenches (B, C, 6) along the contact frames' axes, turned by pytorch-kinematics' poses."""
    assert samples.wrench is not None
    if not samples.wrench_in_world:
        return samples.wrench
    poses = robot.link_poses(samples.joint_position)
    R = torch.stack([samples.base.rotation @ poses[c.frame][:, :3, :3] for c in contacts], dim=1)
    return (samples.wrench.unflatten(2, (2, 3)) @ R).flatten(2)


def reference(
    robot: Robot, contacts: Sequence[Contact], sensors: SensorSet, samples: Samples, state: State
) -> tuple[Array, Array, int]:
    """Gram matrix of all whitened rows [K | f], (12 L + 1, 12 L + 1), the size of each column, and the rows' number."""
    tensors = [torch.from_numpy(x) for x in state]
    rows = [(c, k) for c, contact in enumerate(contacts) for k in contact.components]
    places, components = [c for c, _ in rows], [k for _, k in rows]
    J = torch.zeros(len(samples), 0, 6, robot.nv, dtype=torch.float64)
    if contacts:
        J = torch.stack([FrameJacobian(robot, contact.frame)(tensors[0]) for contact in contacts], dim=1)
    noise = sensors.noise
    project = Projection(
        sensors.torque,
        sensors.wrench[places, components],
        robot.base_rows,
        noise.joint_torque,
        torch.from_numpy(noise.wrench_std[components]),
        torch.from_numpy(noise.base_std[: robot.base_rows]),
    )
    K = Regressor(robot)(*tensors).contiguous()
    torque = torch.where(torch.from_numpy(sensors.torque), samples.torque, torch.nan)
    wrench = local_wrenches(robot, contacts, samples)[:, places, components]
    groups = project(J[:, places, components], samples.active[:, places], K, torque, wrench)
    assert sum(len(group.index) for group in groups) == len(samples)
    X = torch.cat([torch.cat([group.K, group.f[..., None]], dim=2).flatten(0, 1) for group in groups]).numpy()
    least = min(noise.joint_torque, *noise.wrench_std, *noise.base_std)
    force = np.hypot(np.linalg.norm(samples.torque), np.linalg.norm(samples.wrench))
    size = np.append(np.linalg.norm(K.flatten(0, 1).numpy(), axis=0), force) / least
    return X.T @ X, np.maximum(size, 1e-3 * size.max()), len(X)


def assert_same_rows(
    robot: Robot, contacts: Sequence[Contact], sensors: SensorSet, samples: Samples, state: State
) -> None:
    """`R^T R` of the factor is the Gram matrix of the plain path's rows: the same equations but for a rotation."""
    builder = RowBuilder(robot, contacts, sensors)
    factor = compress([samples], builder, chunk=16)
    problem = linear_problem(factor, builder, robot)
    left_over = np.append(np.zeros(problem.A.shape[1]), np.sqrt(problem.residual))
    X = np.vstack([np.column_stack([problem.A, problem.b]), left_over])
    gram, size, rows = reference(robot, contacts, sensors, samples, state)
    assert factor.rows == rows
    np.testing.assert_allclose(X.T @ X / np.outer(size, size), gram / np.outer(size, size), rtol=0.0, atol=1e-13)


SETS = ("full", "contacts", "joints", "mixed", "nothing")
CONTACTS = [
    *(Contact(f"corner_{corner}", "point") for corner in range(4)),
    Contact("left_sole", "flat"),
    Contact("right_sole", "line", "x"),
    Contact("tail_tip", "line", "z"),
    Contact("right_foot", "point"),
]


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), fixed_base=st.booleans(), world=st.booleans())
def test_fast_rows_are_the_plain_ones_whatever_is_measured_touches_and_however_frames_are_turned(
    walker: Path, seed: int, fixed_base: bool, world: bool
) -> None:
    rng = np.random.default_rng(seed)
    robot = loaded(walker, fixed_base)
    kinds = ("point", "line", "flat")
    chosen = [c for c in CONTACTS if rng.random() < 0.6]
    contacts = [Contact(c.frame, kinds[rng.integers(3)], "xyz"[rng.integers(3)]) for c in chosen]
    share = rng.random(2)
    sensors = SensorSet(rng.random(robot.n) < share[0], rng.random((len(contacts), 6)) < share[1], NOISE)
    samples, state = random_samples(robot, contacts, 30, rng, world and not fixed_base)
    assert_same_rows(robot, contacts, sensors, samples, state)


@pytest.mark.parametrize("sensors", SETS)
def test_four_points_on_one_rigid_foot_count_once(walker: Path, sensors: str) -> None:
    """Twelve unmeasured forces on a foot push in six directions: as many equations are left as with a flat foot."""
    robot, rows = load(walker), {}
    for feet in (CONTACTS[:4], CONTACTS[4:5]):
        samples, state = random_samples(robot, feet, 40, 2)
        samples.active[:] = True
        chosen = sensor_set(sensors if sensors != "mixed" else "joints", robot, feet)
        assert_same_rows(robot, feet, chosen, samples, state)
        rows[len(feet)] = compress([samples], RowBuilder(robot, feet, chosen)).rows
    assert rows[4] == rows[1]


@pytest.mark.parametrize("world", [False, True], ids=["local", "world"])
def test_evaluation_measures_and_predicts_what_the_plain_path_does(walker: Path, world: bool) -> None:
    robot, rng = load(walker), np.random.default_rng(4)
    samples, state = random_samples(robot, CONTACTS, 40, rng, world)
    builder = RowBuilder(robot, CONTACTS, named_sensors("full", robot.n, len(CONTACTS)))
    phi = rng.normal(size=(3, robot.nominal.size))
    phi.reshape(3, -1, 12)[:, 0, 10:] = 0.0  # the base has no joint
    measured, predicted = force_series(builder, samples, phi)
    q, v, a = map(torch.from_numpy, state)
    expected = torch.nn.functional.pad(samples.torque, (6, 0))
    wrench = local_wrenches(robot, CONTACTS, samples)
    for place, contact in enumerate(CONTACTS):
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
