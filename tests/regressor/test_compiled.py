"""Compiled modules are what torch's operators make: values, gradients, any batch, threads and transformations."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from regressors import assert_close, base_kinds, of_every_robot, of_robots, tensors
from synthetic import BAXTER, G1, PANDA, ROBOTS, SOLO12, TIAGO, UR5, load, random_states
from torch import Tensor

import torchid
from torchid import kernels
from torchid.regressor import FrameJacobian, InverseDynamics, Regressor
from torchid.regressor.compiled import Referenced
from torchid.robot import Robot

REFUSED = ("ur3.urdf", "alex_psyonic_hands.urdf")
URDFS = [path for path in sorted(ROBOTS.rglob("*.urdf")) if path.name not in REFUSED]
pytestmark = pytest.mark.usefixtures("both_ways")
only_compiled = pytest.mark.skipif(kernels.compiled() is None, reason="no C++ compiler")


def modules(robot: Robot, **kwargs: float) -> list[tuple[Referenced, int]]:
    """Each with the number of its arguments of q, v, a and parameters."""
    frame = FrameJacobian(robot, list(robot.links)[-1])
    return [(Regressor(robot, **kwargs), 3), (InverseDynamics(robot, **kwargs), 4), (frame, 1)]


def arguments(robot: Robot, samples: int, seed: int) -> tuple[Tensor, ...]:
    rng = np.random.default_rng(seed)
    state = random_states(rng, robot.n, samples, robot.fixed_base)
    return tuple(x.requires_grad_() for x in tensors(*state, rng.normal(size=(samples, robot.nominal.size))))


@base_kinds
@of_every_robot([SOLO12, G1, PANDA, BAXTER], URDFS)
@pytest.mark.parametrize("sign_width", [None, 0.3])
def test_values_and_gradients_are_those_of_torchs_operators(
    urdf: Path, fixed_base: bool, sign_width: float | None
) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    inputs = arguments(robot, 11, 31)
    for module, count in modules(robot, sign_width=sign_width)[: 3 if robot.n else 2]:
        found = module(*inputs[:count])
        expected = module.reference(*inputs[:count])
        if count < 4:
            expected = expected.permute(2, 0, 1)
        assert_close(found.detach().numpy(), expected.detach().numpy(), 1e-12)
        weights = torch.from_numpy(np.random.default_rng(32).normal(size=tuple(found.shape)))
        for x, y in zip(*(torch.autograd.grad(out, inputs[:count], weights) for out in (found, expected)), strict=True):
            assert_close(x.numpy(), y.numpy(), 1e-9)


@of_robots(PANDA, TIAGO)
def test_first_and_second_derivatives_by_differences(urdf: Path) -> None:
    """Of revolute, prismatic and mimic joints."""
    robot = load(urdf)
    inputs = arguments(robot, 1, 33)
    for module, count in modules(robot, sign_width=0.5):
        assert torch.autograd.gradcheck(module, inputs[:count], fast_mode=True)
        assert torch.autograd.gradgradcheck(module, inputs[:count], fast_mode=True)


def test_derivatives_of_a_fixed_base(small: Robot) -> None:
    robot = load(small.path, fixed_base=True)
    inputs = arguments(robot, 2, 34)
    for module, count in modules(robot):
        assert torch.autograd.gradcheck(module, inputs[:count], fast_mode=True)


def test_gradients_in_single_precision_agree_to_its_digits(small: Robot) -> None:
    inputs = arguments(small, 5, 35)
    for module, count in modules(small, sign_width=0.5):
        exact = torch.autograd.grad(module(*inputs[:count]).square().sum(), inputs[:count])
        single = [x.detach().float().requires_grad_() for x in inputs[:count]]
        found = torch.autograd.grad(module.float()(*single).square().sum(), single)
        for x, y in zip(found, exact, strict=True):
            assert x.dtype == torch.float32
            assert_close(x.numpy(), y.numpy(), 2e-5)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,), (2, 0), (1, 1, 2)])
def test_any_leading_dimensions_are_those_of_the_result(small: Robot, shape: tuple[int, ...]) -> None:
    count = int(np.prod(shape))
    flat = [x.detach() for x in arguments(small, count, 36)]
    inputs = [x.reshape(*shape, x.shape[1]) for x in flat]
    for module, number in modules(small):
        found = module(*inputs[:number])
        expected = module(*flat[:number])
        assert found.shape == (*shape, *expected.shape[1:])
        assert torch.equal(found.reshape(expected.shape), expected)
    one = InverseDynamics(small)(*inputs[:3], torch.from_numpy(small.nominal.flatten()))
    assert_close(one.numpy(), (Regressor(small)(*inputs[:3]) @ torch.from_numpy(small.nominal.flatten())).numpy())


def test_memory_is_written_again(small: Robot) -> None:
    (q, v, a, _) = (x.detach() for x in arguments(small, 6, 37))
    K = Regressor(small)
    out = K(q, v, a)
    expected = K(q.flip(0), a, v)
    address = out.data_ptr()
    assert K(q.flip(0), a, v, out=out) is out
    assert torch.equal(out, expected)
    assert out.data_ptr() == address
    K(*(x.reshape(2, 3, -1) for x in (q, v, a)), out=out.unflatten(0, (2, 3)))
    assert torch.equal(out, K(q, v, a))
    for wrong in (out[:5], out.unflatten(0, (2, 3))):
        with pytest.raises(
            ValueError, match=r"out: found shape .*; accepted: what an earlier call returned for sample"
        ):
            K(q, v, a, out=wrong)
    with pytest.raises(TypeError, match="out: found ndarray; accepted: a tensor that an earlier call returned"):
        K(q, v, a, out=out.numpy())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="accepted: what an earlier call returned"):
        K(q, v, a, out=out.contiguous())
    with pytest.raises(TypeError, match="out: found torch.float32; accepted: torch.float64"):
        K(q, v, a, out=out.float())
    with pytest.raises(TypeError, match="out: found arguments that require a gradient"):
        K(q.requires_grad_(), v, a, out=out)


def test_memory_of_any_content_gives_the_right_result(small: Robot, tmp_path: Path) -> None:
    (q, v, a, _) = (x.detach() for x in arguments(small, 6, 47))
    other = tmp_path / "other.urdf"
    other.write_text(small.path.read_text().replace('<parent link="c"/>', '<parent link="base"/>'))
    K = Regressor(small)
    expected = K(q, v, a)
    touched = K(q, v, a).add_(1.0)
    for out in (torch.full_like(expected, 7.0), touched, Regressor(load(other))(q, v, a), expected.clone()):
        assert torch.equal(K(q, v, a, out=out), expected)


def test_memory_that_a_gradient_needs_is_missed(small: Robot) -> None:
    (q, v, a, phi) = (x.detach() for x in arguments(small, 6, 48))
    K = Regressor(small)
    phi = phi.requires_grad_()
    out = K(q, v, a)
    loss = (out * phi[:, None]).sum(-1).square().mean()
    K(q, v, a, out=out)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_parameters_of_another_shape_are_refused(small: Robot) -> None:
    (q, v, a, phi) = arguments(small, 3, 38)
    for wrong in (phi[:2], phi[:, 1:], phi[None], phi[0, :-1]):
        with pytest.raises(ValueError, match=r"phi: found shape .*; accepted: \(60,\) or \(3, 60\)"):
            InverseDynamics(small)(q, v, a, wrong)
    with pytest.raises(TypeError, match="phi: found ndarray; accepted: a tensor"):
        InverseDynamics(small)(q, v, a, phi.detach().numpy())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="phi: found torch.float32; accepted: torch.float64"):
        InverseDynamics(small)(q, v, a, phi.float())


@base_kinds
@of_robots(PANDA, G1, BAXTER, UR5)
def test_regrouped_columns_make_all_columns(urdf: Path, fixed_base: bool) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    (q, v, a, _) = arguments(robot, 4, 39)
    K = Regressor(robot, regrouped=True)
    assert K.reduction is not None
    assert_close((K(q, v, a) @ K.reduction).detach().numpy(), Regressor(robot)(q, v, a).detach().numpy(), 1e-13)
    assert_close(K(q, v, a).detach().numpy(), K.reference(q, v, a).permute(2, 0, 1).detach().numpy(), 1e-12)


def test_regrouped_columns_of_a_floating_base_are_base_parameters() -> None:
    robot = load(SOLO12)
    K = Regressor(robot, regrouped=True)
    rows = K(*(x.detach() for x in arguments(robot, 60, 40)[:3])).flatten(0, 1)
    assert torch.linalg.matrix_rank(rows) == rows.shape[1] == 10 + 7 * 12 + 2 * 12


TRANSFORMS: dict[str, Callable[[Callable[..., Tensor]], Callable[..., Tensor]]] = {
    "vmap": lambda f: torch.func.vmap(f, in_dims=(0, 0, 0, None)),
    "vmap over the second dimension": lambda f: (
        lambda q, v, a, phi: torch.func.vmap(f, in_dims=(1, 1, 1, None))(q.T, v.T, a.T, phi)
    ),
    "grad": lambda f: torch.func.grad(lambda *x: f(*x).square().sum(), 3),
    "mapped gradients": lambda f: torch.func.vmap(
        torch.func.grad(lambda *x: f(*x).square().sum(), 0), in_dims=(0, 0, 0, None)
    ),
    "jvp": lambda f: lambda *x: torch.func.jvp(f, x, tuple(map(torch.ones_like, x)))[1],
    "jacfwd": lambda f: torch.func.jacfwd(f, 3),
    "jacrev": lambda f: torch.func.jacrev(f, 1),
    "hessian": lambda f: torch.func.hessian(lambda *x: f(*x).square().sum(), 3),
    "compiled": lambda f: torch.compile(f, backend="aot_eager", fullgraph=True),
}


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # by torch's own jvp
@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS.keys())
def test_transformations_of_torch_go_on_working(
    small: Robot, transform: Callable[[Callable[..., Tensor]], Callable[..., Tensor]]
) -> None:
    (q, v, a, _) = (x.detach() for x in arguments(small, 3, 41))
    phi = torch.from_numpy(small.nominal.flatten())
    module = InverseDynamics(small, sign_width=0.5)
    found = transform(module)(q, v, a, phi)

    def by_torch(*inputs: Tensor) -> Tensor:
        samples = inputs[0].shape[:-1]
        state = (x.reshape(-1, x.shape[-1]) for x in inputs[:3])
        return module.reference(*state, inputs[3]).reshape(*samples, -1)

    expected = by_torch if transform is TRANSFORMS["compiled"] else transform(by_torch)
    assert_close(found.numpy(), expected(q, v, a, phi).numpy(), 1e-12)


@only_compiled
def test_operators_keep_the_rules_of_torch(small: Robot) -> None:
    if kernels.compiled() is None:
        pytest.skip("torch's own operators do")
    inputs = arguments(small, 3, 42)
    for module, count in modules(small):
        tables = module.regressor if isinstance(module, InverseDynamics) else module
        shape = getattr(tables, "shape", (small.n_rows, 0))
        names = {1: "frame_jacobian", 3: "regressor", 4: "inverse_dynamics"}
        operator = getattr(torch.ops.torchid, names[count]).default
        buffers = tables.get_buffer("table"), tables.get_buffer("reals")
        torch.library.opcheck(operator, (*inputs[:count], *buffers, *shape, module.number))


@only_compiled
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_two_threads_give_the_same_bits(dtype: torch.dtype) -> None:
    robot = load(SOLO12)
    inputs = [x.detach().to(dtype).requires_grad_() for x in arguments(robot, 1100, 43)]
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            for module, number in modules(robot):
                out = module.to(dtype)(*inputs[:number])
                results.append([out, *torch.autograd.grad(out, inputs[:number], torch.ones_like(out))])
    finally:
        torch.set_num_threads(threads)
    for one, two in zip(results[:3], results[3:], strict=True):
        assert all(map(torch.equal, one, two))


def test_gradients_of_parameters_alone_are_those_beside_others(small: Robot) -> None:
    (q, v, a, phi) = arguments(small, 5, 46)
    module = InverseDynamics(small)
    for parameters in (phi, phi[0].detach().requires_grad_()):
        expected = torch.autograd.grad(module(q, v, a, parameters).square().sum(), [q, parameters])[1]
        alone = module(q.detach(), v.detach(), a.detach(), parameters).square().sum()
        assert torch.equal(torch.autograd.grad(alone, parameters)[0], expected)


def test_a_module_without_kernels_says_why(small: Robot) -> None:
    assert ("without a compiler" in repr(Regressor(small))) == (kernels.compiled() is None)


def test_a_copy_is_differentiated_twice_without_the_original(small: Robot) -> None:
    module = copy.deepcopy(InverseDynamics(small))
    (q, v, a, phi) = arguments(small, 2, 44)
    (first,) = torch.autograd.grad(module(q, v, a, phi).square().sum(), q, create_graph=True)
    assert torch.autograd.grad(first.sum(), phi)[0].isfinite().all()


def test_a_module_says_nothing_of_a_missing_number(small: Robot) -> None:
    (q, v, a, _) = (x.detach() for x in arguments(small, 9, 45))
    q[3, 8] = torch.nan
    K = torchid.Regressor(small)(q, v, a)
    good = torch.arange(9) != 3
    assert K[good].isfinite().all()
    assert K[3].isnan().any()
