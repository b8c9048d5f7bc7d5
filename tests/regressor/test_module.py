"""The regressor and the Jacobians as modules: shapes, precision, gradients, and the regrouped columns."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from regressors import assert_close, base_kinds, of_robots, regressor, tensors
from synthetic import (
    ANYMAL,
    BAXTER,
    DRONE,
    G1,
    PANDA,
    ROMEO,
    SOLO12,
    TALOS,
    TIAGO,
    TIAGO_PRO,
    UR5,
    Array,
    load,
    random_states,
)
from torch.optim.swa_utils import AveragedModel

from torchid import parameters
from torchid.errors import InputError, UnknownNameError
from torchid.regressor import FrameJacobian, LoopJacobian, Regressor, motion_from_state
from torchid.regressor.columns import all_wrench_columns, reduced_layout, reduction_matrix
from torchid.regressor.kinematics import body_states, joint_motion, joint_screw_axes
from torchid.regressor.regressor import joint_row, joint_rows
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot

pytestmark = pytest.mark.usefixtures("both_ways")


@pytest.mark.parametrize("samples", [0, 1, 5])
def test_shapes_follow_the_batch(small: Robot, samples: int) -> None:
    q, v, a = tensors(*random_states(np.random.default_rng(14), small.n, samples))
    assert Regressor(small)(q, v, a).shape == (samples, 9, 60)
    assert FrameJacobian(small, "c")(q).shape == (samples, 6, 9)


def test_a_quaternion_of_norm_0_is_no_turn_and_has_finite_gradients(small: Robot) -> None:
    q, v, a = tensors(*random_states(np.random.default_rng(16), small.n, 2))
    q[0, 3:7] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    level = q.clone()
    q[0, 3:7] = 0.0
    K, J = Regressor(small), FrameJacobian(small, "c", radius=0.1)
    assert torch.equal(K(q.requires_grad_(), v, a), K(level, v, a))
    assert torch.equal(J(q), J(level))
    (K(q, v, a).square().sum() + J(q).square().sum()).backward()
    assert q.grad is not None
    assert q.grad.isfinite().all()


def test_compiled_and_exported_they_are_the_same(small: Robot) -> None:
    state, more = (tensors(*random_states(np.random.default_rng(15), small.n, samples)) for samples in (3, 7))
    K, J = Regressor(small), FrameJacobian(small, "c")
    for module, inputs in ((K, state), (J, state[:1])):
        whole_graph = torch.compile(module, backend="eager", fullgraph=True)  # `export` traces what comes after
        assert_close(whole_graph(*inputs).numpy(), module(*inputs).numpy(), 1e-14)
    batch = torch.export.Dim("batch")
    exported = torch.export.export(K, tuple(state), dynamic_shapes=({0: batch},) * 3)
    assert_close(exported.module()(*more).numpy(), K(*more).numpy(), 1e-15)


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
def test_samples_may_be_mapped_over(small: Robot) -> None:
    state, K = tensors(*random_states(np.random.default_rng(15), small.n, 3)), Regressor(small)
    mapped = torch.func.vmap(lambda *sample: K(*(x[None] for x in sample))[0])(*state)
    assert_close(mapped.numpy(), K(*state).numpy(), 1e-15)


def test_what_is_no_tensor_is_refused(small: Robot) -> None:
    q, v, a = random_states(np.random.default_rng(15), small.n, 3)
    with pytest.raises(TypeError, match="q, v, a: found ndarray; accepted: tensors"):
        Regressor(small)(*tensors(q, v), a)  # type: ignore[arg-type]


@base_kinds
@of_robots(G1, PANDA)
def test_single_precision_stays_single_and_agrees_to_its_digits(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    state = tensors(*random_states(np.random.default_rng(17), robot.n, 8, fixed_base))
    frame = list(robot.links)[-1]
    K, J = Regressor(robot), FrameJacobian(robot, frame)
    exact, exact_J = K(*state).numpy(), J(state[0]).numpy()
    single = [x.to(torch.float32) for x in state]
    found, found_J = K.to(torch.float32)(*single), J.to(torch.float32)(single[0])
    assert found.dtype == found_J.dtype == torch.float32
    for module in (K, J):
        assert all(x.dtype == torch.float32 for x in module.buffers() if x.is_floating_point())
    assert_close(found.numpy(), exact, 1e-5)
    assert_close(found_J.numpy(), exact_J, 1e-5)


def test_a_state_is_refused_by_another_robot_of_the_same_shapes(small: Robot, tmp_path: Path) -> None:
    moved, renamed = tmp_path / "moved.urdf", tmp_path / "renamed.urdf"
    text = small.path.read_text()
    moved.write_text(text.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0.001"/>'))
    renamed.write_text(text.replace('link name="base"', 'link name="torso"').replace('"base"', '"torso"'))
    model = torch.nn.ModuleList([Regressor(small), FrameJacobian(small, "c"), torch.nn.Linear(3, 1)])
    torch.save(model.state_dict(), tmp_path / "model.pt")
    state = torch.load(tmp_path / "model.pt", weights_only=True)
    for same in (model.float(), copy.deepcopy(model), pickle.loads(pickle.dumps(model)), AveragedModel(model).module):
        same.load_state_dict(state)
    Regressor(load(renamed)).load_state_dict(Regressor(small).state_dict())  # names change no equation
    for module in (Regressor, LoopJacobian):
        with pytest.raises(InputError, match="^load_state_dict: robot: another robot: d differ; accepted"):
            module(load(moved)).load_state_dict(module(small).state_dict())
    with pytest.raises(InputError, match="another robot, with 5 frames and 3 joints instead of 13 frames and 12 j"):
        Regressor(load(SOLO12)).load_state_dict(Regressor(small).state_dict())


WRONG_SHAPES = {
    "q without the base": lambda q, v, a: (q[:, 7:], v, a),
    "q without a joint": lambda q, v, a: (q[:, :-1], v, a),
    "v without the base": lambda q, v, a: (q, v[:, 6:], a),
    "a without a joint": lambda q, v, a: (q, v, a[:, :-1]),
    "all without a joint": lambda q, v, a: (q[:, :-1], v[:, :-1], a[:, :-1]),
    "a joint too many": lambda q, v, a: tuple(torch.cat([x, x[:, -1:]], 1) for x in (q, v, a)),
    "more v than q": lambda q, v, a: (q[:2], v, a),
    "one v for all": lambda q, v, a: (q, v[:1], a[:1]),
    "one q for all": lambda q, v, a: (q[:1], v, a),
    "v without a batch": lambda q, v, a: (q, v[0], a[0]),
}


@pytest.mark.parametrize("spoil", WRONG_SHAPES.values(), ids=WRONG_SHAPES.keys())
def test_shapes_that_do_not_belong_together_are_refused(small: Robot, spoil: object) -> None:
    state = tensors(*random_states(np.random.default_rng(19), small.n, 3))
    assert callable(spoil)
    with pytest.raises(ValueError, match="accepted"):
        Regressor(small)(*spoil(*state))


@pytest.mark.parametrize("columns", [slice(1, None), slice(7, None), slice(0, 5)], ids=["narrow", "no base", "few"])
def test_a_jacobian_refuses_coordinates_of_another_robot(small: Robot, columns: slice) -> None:
    q, _, _ = tensors(*random_states(np.random.default_rng(20), small.n, 3))
    with pytest.raises(ValueError, match="accepted"):
        FrameJacobian(small, "c")(q[:, columns])


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
@pytest.mark.parametrize("wrong", ["q", "v", "a"])
def test_one_argument_of_another_precision_is_refused_by_name(small: Robot, wrong: str, dtype: torch.dtype) -> None:
    state = dict(zip("qva", tensors(*random_states(np.random.default_rng(23), small.n, 2)), strict=True))
    with pytest.raises(TypeError, match=f"^{wrong}: found {dtype}; accepted: torch.float64"):
        Regressor(small)(**state | {wrong: state[wrong].to(dtype)})


def test_a_jacobian_of_no_link_is_refused_by_the_nearest_names() -> None:
    with pytest.raises(UnknownNameError, match="unknown name 'left_anklle_roll_link'; accepted: left_ankle_roll_link"):
        FrameJacobian(load(G1), "left_anklle_roll_link")


def test_the_regressor_is_differentiable_by_motion(small: Robot) -> None:
    state = [x.requires_grad_() for x in tensors(*random_states(np.random.default_rng(21), small.n, 2))]
    K = Regressor(small)
    weights = torch.from_numpy(np.random.default_rng(22).normal(size=(12 * len(small.bodies), 3)))
    assert torch.autograd.gradcheck(lambda q, v, a: K(q, v, a) @ weights, state)
    assert torch.autograd.gradcheck(K, state, fast_mode=True)


def test_a_jacobian_is_differentiable_by_coordinates(small: Robot) -> None:
    q, _, _ = tensors(*random_states(np.random.default_rng(23), small.n, 2))
    assert torch.autograd.gradcheck(FrameJacobian(small, "c"), q.requires_grad_())


def reduced_regressor(robot: Robot, *state: Array) -> Array:
    """K's inertial part in the columns that are left after regrouping, (B, nv, columns)."""
    tree = KinematicTree(robot)
    layout = reduced_layout(tree)
    joints = joint_motion(tree, motion := motion_from_state(*tensors(*state), robot.n, robot.fixed_base))
    states = body_states(tree, motion, joints)
    wrenches = all_wrench_columns(states, layout)
    directions = joint_screw_axes(tree, states)
    rows = [wrenches] if tree.base_rows else []
    for row in joint_rows(tree, layout):
        full = wrenches.new_zeros(1, layout.count, wrenches.shape[-1])
        full[0, row.start : row.end] = joint_row(row, tree, layout, directions, wrenches)
        rows.append(full)
    return torch.cat(rows).permute(2, 0, 1).numpy()


@base_kinds
@of_robots(ANYMAL, BAXTER, DRONE, G1, PANDA, ROMEO, TALOS, TIAGO, TIAGO_PRO, UR5)
def test_all_columns_follow_from_the_regrouped_ones(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    if not robot.nv:
        return
    state = random_states(np.random.default_rng(24), robot.n, 3, fixed_base)
    full = regressor(robot, *state)[..., parameters.INERTIAL]
    B = reduction_matrix(KinematicTree(robot))
    assert_close(reduced_regressor(robot, *state) @ B, full.reshape(*full.shape[:2], -1))


def test_tensors_of_another_device_are_refused_by_its_name(small: Robot) -> None:
    q, v, a = tensors(*random_states(np.random.default_rng(23), small.n, 2))
    with pytest.raises(TypeError, match="found devices meta, cpu; accepted: one device"):
        motion_from_state(q.to("meta"), v, a, small.n)
    with pytest.raises(TypeError, match=r"^v: found meta; accepted: cpu \(the module.s device\); convert v, or"):
        Regressor(small)(q, v.to("meta"), a)
    with pytest.raises(TypeError, match=r"q: found meta; accepted: cpu \(the module.s device\); convert q, or"):
        FrameJacobian(small, "c")(q.to("meta"))


def test_the_path_of_a_robot_is_no_robot() -> None:
    for module in (Regressor, LoopJacobian):
        with pytest.raises(TypeError, match="robot: found str; accepted: a Robot from torchid.load_robot"):
            module(str(SOLO12))  # type: ignore[arg-type]
