"""The projection: what is not measured leaves no trace, what is left is exact."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import ANYMAL, SOLO12, Array, load, random_states
from torch import Tensor

from torchid.regressor import FrameJacobian
from torchid.robot import Robot
from torchid.sensing import Contact, ProjectedGroup, Projection

pytestmark = pytest.mark.usefixtures("both_ways")
FEET = [Contact(f"{leg}_FOOT", "point") for leg in ("LF", "RF", "LH", "RH")]
robot_of = cache(load)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=20, deadline=None, derandomize=True)


def numpy_projector(A: Array) -> tuple[Array, float]:
    """Onto the null space of one matrix (k, m), and the rounding to expect of it.

    It grows with A's condition, and with singular values of redundant rows, which are dropped.
    """
    _, values, Vh = np.linalg.svd(A)
    is_kept = values > 1e-9 * max(values, default=0.0)
    kept, dropped = values[is_kept], max(values[~is_kept], default=0.0)
    rounding = (1e-14 * kept[0] + dropped) / kept[-1] if len(kept) else 1e-14
    return Vh[len(kept) :].T @ Vh[len(kept) :], float(rounding)


# ------------------------------------------------------------------------------------------------------- projection


class Scene:
    """Random postures and forces of a robot in random contact states."""

    def __init__(self, robot: Robot, contacts: Sequence[Contact], seed: int, samples: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self.q, _, _ = map(torch.from_numpy, random_states(rng, robot.n, samples))
        self.robot, self.contacts = robot, contacts
        self.components = [(c, k) for c, contact in enumerate(contacts) for k in contact.components]
        self.touching = torch.from_numpy(rng.random((samples, len(contacts))) < 0.5)
        self.K = torch.from_numpy(rng.normal(size=(samples, robot.nv, 9)))
        self.torque = torch.from_numpy(20.0 * rng.normal(size=(samples, robot.n)))
        self.wrench = torch.from_numpy(50.0 * rng.normal(size=(samples, len(self.components))))

    @cached_property
    def J(self) -> Tensor:
        frames = [FrameJacobian(self.robot, contact.frame)(self.q) for contact in self.contacts]
        rows = [frames[c][:, k] for c, k in self.components]
        return torch.stack(rows, dim=1) if rows else torch.zeros(len(self.q), 0, self.robot.nv, dtype=torch.float64)

    @property
    def active(self) -> Tensor:
        return self.touching[:, [c for c, _ in self.components]]

    def project(self, projection: Projection, **options: bool) -> list[ProjectedGroup]:
        return projection(self.J, self.active, self.K, self.torque, self.wrench, **options)

    def expected(self, sample: int, torque: Array, wrench: Array) -> tuple[Array, float, Array]:
        """Projector (nv, nv), its rounding, and measured force (nv,) of one sample, from the masks, by numpy."""
        J, active = self.J[sample].numpy(), self.active[sample].numpy()
        S = np.eye(self.robot.nv)[6:]
        f = S[torque].T @ self.torque[sample].numpy()[torque]
        f += J[active & wrench].T @ self.wrench[sample].numpy()[active & wrench]
        return *numpy_projector(np.vstack([S[~torque], J[active & ~wrench]])), f


def check(scene: Scene, torque: Array, wrench: Array) -> list[ProjectedGroup]:
    """The projection of every sample equals numpy's, which knows no batch, state or rank."""
    groups = scene.project(Projection(torque, wrench))
    assert sorted(torch.cat([group.index for group in groups]).tolist()) == list(range(len(scene.q)))
    for group in groups:
        for i, sample in enumerate(group.index.tolist()):
            P, rounding, f = scene.expected(sample, torque, wrench)
            V, K, size = group.V[i].numpy(), scene.K[sample].numpy(), np.abs(f).max()
            np.testing.assert_allclose(V @ V.T, P, rtol=0.0, atol=rounding)
            np.testing.assert_allclose(V @ group.K[i].numpy(), P @ K, rtol=0.0, atol=10.0 * rounding)
            np.testing.assert_allclose(V @ group.f[i].numpy(), P @ f, rtol=0.0, atol=10.0 * rounding * size)
            assert group.base_rank[i] == np.linalg.matrix_rank(P[:6], tol=1e-6)
            np.testing.assert_array_equal(group.active, scene.active[sample])
    return groups


@few
@given(seed=seeds)
def test_any_sensors_project_as_sample_by_sample_with_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot, kind = robot_of(ANYMAL), rng.choice(["point", "line", "flat"])
    scene = Scene(robot, [Contact(foot.frame, kind) for foot in FEET], seed)
    share = rng.random(2)
    check(scene, rng.random(robot.n) < share[0], rng.random(len(scene.components)) < share[1])


def test_no_samples_make_no_groups() -> None:
    assert Scene(robot_of(ANYMAL), FEET, 4, samples=0).project(Projection([True] * 12, [False] * 12)) == []


def test_a_bolted_base_has_no_rows_and_no_base_to_lose() -> None:
    rng = np.random.default_rng(5)
    K, torque, J = (torch.from_numpy(rng.normal(size=size)) for size in ((5, 4, 2), (5, 4), (5, 2, 4)))
    active, unread = torch.ones(5, 2, dtype=torch.bool), torch.full((5, 2), torch.nan, dtype=torch.float64)
    (group,) = Projection([True] * 4, [False, False], base_rows=0)(J, active, K, torque, unread)
    assert group.V.shape == (5, 4, 2)
    assert not group.base_rank.any()
    for sample in range(5):
        P, rounding = numpy_projector(J[sample].numpy())
        f = (group.V[sample] @ group.f[sample]).numpy()
        np.testing.assert_allclose(f, P @ torque[sample].numpy(), rtol=0.0, atol=10.0 * rounding)


# --------------------------------------------------------------------------------------------------- lost directions


# ------------------------------------------------------------------------------------------------- noise, leaks, grads


def noises(scene: Scene, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    return rng.uniform(0.1, 2.0, 12), rng.uniform(0.5, 5.0, len(scene.components)), rng.uniform(0.1, 1.0, 6)


@few
@given(seed=seeds)
def test_whitened_rows_have_unit_noise_and_span_the_same_equations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, share = Scene(robot_of(ANYMAL), FEET, seed), rng.random(2)
    torque, wrench = rng.random(12) < share[0], rng.random(12) < share[1]
    torque_std, wrench_std, base_std = noises(scene, rng)
    project = Projection(torque, wrench, 6, *map(torch.from_numpy, (torque_std, wrench_std, base_std)))
    for group in scene.project(project):
        for i, sample in enumerate(group.index.tolist()):
            J = (scene.J[sample].numpy() * wrench_std[:, None])[scene.active[sample].numpy() & wrench]
            covariance = np.diag(np.concatenate([base_std, torque_std]) ** 2) + J.T @ J
            P, rounding, f = scene.expected(sample, torque, wrench)
            V = group.V[i].numpy()
            assert V.shape[1] == round(np.trace(P))
            np.testing.assert_allclose(V.T @ covariance @ V, np.eye(V.shape[1]), rtol=0.0, atol=1e-12)
            size = np.abs(V).max(initial=0.0)
            np.testing.assert_allclose(P @ V, V, rtol=0.0, atol=10.0 * rounding * size)
            np.testing.assert_allclose(group.K[i], V.T @ scene.K[sample].numpy(), rtol=0.0, atol=1e-13 * size)
            np.testing.assert_allclose(group.f[i], V.T @ f, rtol=0.0, atol=1e-13 * size * np.abs(f).max())


def test_noise_is_given_whole_or_not_at_all() -> None:
    with pytest.raises(ValueError, match="all three or none"):
        Projection([True], [True], torque_noise=0.5)
    with pytest.raises(ValueError, match="all three or none"):
        Projection([True], [True], torque_noise=0.5, wrench_noise=1.0)


@pytest.mark.parametrize("noise", [None, 0.5], ids=["orthonormal", "whitened"])
def test_what_is_not_measured_or_does_not_touch_never_reaches_the_result(noise: float | None) -> None:
    rng = np.random.default_rng(9)
    scene = Scene(robot_of(ANYMAL), FEET, 9)
    torque, wrench = rng.random(12) < 0.5, rng.random(12) < 0.5
    project = Projection(torque, wrench, 6, noise, noise, noise)
    readings = scene.wrench
    scene.wrench = readings.clone().requires_grad_()
    expected = scene.project(project)
    scene.torque[:, ~torque] = torch.nan
    readings[:, ~wrench] = torch.nan
    readings[~scene.active] = torch.nan
    scene.wrench = readings.requires_grad_()
    for group, other in zip(scene.project(project), expected, strict=True):
        torch.testing.assert_close(group.f, other.f, rtol=0.0, atol=0.0)
        torch.testing.assert_close(group.K, other.K, rtol=0.0, atol=0.0)
    sum(group.f.sum() for group in scene.project(project)).backward()
    assert scene.wrench.grad is not None
    assert not scene.wrench.grad[~(scene.active & torch.from_numpy(wrench))].any()


@pytest.mark.parametrize("noise", [None, 0.5], ids=["orthonormal", "whitened"])
def test_projected_forces_have_their_gradient_in_the_posture(noise: float | None) -> None:
    """With feet of which nothing, part or all is measured: the null space turns with the legs."""
    scene = Scene(robot_of(ANYMAL), FEET, 11, samples=4)
    scene.touching[:] = torch.tensor([[1, 1, 1, 1], [1, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=torch.bool)
    project = Projection([True] * 9 + [False] * 3, [True] * 3 + [False] * 8 + [True], 6, noise, noise, noise)
    frames = [FrameJacobian(scene.robot, foot.frame) for foot in FEET]

    def squares(joints: Tensor) -> Tensor:
        q = torch.cat([scene.q[:, :7], joints], dim=1)
        J = torch.cat([frame(q)[:, :3] for frame in frames], dim=1)
        groups = project(J, scene.active, scene.K, scene.torque, scene.wrench)
        return torch.cat([(group.K.mean(2) - group.f).square().sum(1) for group in groups])

    assert torch.autograd.gradcheck(squares, scene.q[:, 7:].clone().requires_grad_(), atol=1e-5, rtol=1e-6)


@pytest.mark.parametrize("wrong", range(5), ids=["J_C", "active", "K", "torque", "wrench"])
def test_a_part_of_a_batch_of_another_length_is_refused(wrong: int) -> None:
    batch = (torch.ones(4, 3, 8), torch.ones(4, 3, dtype=torch.bool), *map(torch.ones, ((4, 8, 2), (4, 2), (4, 3))))
    project = Projection([True] * 2, [False] * 3)
    for part in (batch[wrong][:1], torch.cat([batch[wrong]] * 2)):
        with pytest.raises(ValueError, match=r"J_C, active, K, torque, wrench: found shapes .*; accepted: \(B, 3, 8\)"):
            project(*batch[:wrong], part, *batch[wrong + 1 :])


@pytest.mark.parametrize("wrong", ["J_C", "torque", "wrench"])
def test_a_part_of_a_batch_of_another_precision_or_none_is_refused_by_name(wrong: str) -> None:
    touching = torch.ones(4, 3, dtype=torch.bool)
    batch = {
        "J_C": torch.ones(4, 3, 8),
        "K": torch.ones(4, 8, 2),
        "torque": torch.ones(4, 2),
        "wrench": torch.ones(4, 3),
    }
    project = Projection([True] * 2, [False] * 3)
    with pytest.raises(TypeError, match=f"^{wrong}: found torch.float64; accepted: torch.float32, the dtype of K"):
        project(active=touching, **batch | {wrong: batch[wrong].double()})
    with pytest.raises(TypeError, match=f"^{wrong}: found NoneType; accepted: a tensor"):
        project(active=touching, **batch | {wrong: None})


def test_flags_that_are_numbers_are_refused_and_never_taken_for_indices() -> None:
    numbers = torch.ones(4, 3, dtype=torch.int64)
    with pytest.raises(TypeError, match=r"active: found torch.int64; accepted: torch.bool"):
        Projection([True] * 2, [False] * 3)(
            torch.ones(4, 3, 8), numbers, torch.ones(4, 8, 2), torch.ones(4, 2), torch.ones(4, 3)
        )


@few
@given(seed=seeds)
def test_padded_samples_are_those_of_their_groups(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, share = Scene(robot_of(ANYMAL), FEET, seed), rng.random(2)
    torque, wrench = rng.random(12) < share[0], rng.random(12) < share[1]
    noise = tuple(map(torch.from_numpy, noises(scene, rng))) if rng.random() < 0.5 else (None,) * 3
    project = Projection(torque, wrench, 6, *noise)
    padded = scene.project(project, pad=True)
    assert padded.V.shape == (12, 18, 6 + int(torque.sum()))
    for group in scene.project(project):
        V, K, f = (x[group.index] for x in (padded.V, padded.K, padded.f))
        assert torch.equal(padded.base_rank[group.index], group.base_rank)
        assert (V.any(1).sum(1) == group.V.shape[2]).all()
        np.testing.assert_allclose(V @ V.mT, group.V @ group.V.mT, rtol=0.0, atol=1e-12 * float(V.abs().max() ** 2))
        np.testing.assert_allclose(K.mT @ K, group.K.mT @ group.K, rtol=0.0, atol=1e-11 * float(K.abs().max() ** 2))
        size = float(K.abs().max() * f.abs().max())
        np.testing.assert_allclose(K.mT @ f[..., None], group.K.mT @ group.f[..., None], rtol=0.0, atol=1e-11 * size)


@pytest.mark.parametrize("noise", [None, 0.5], ids=["orthonormal", "whitened"])
def test_padded_projections_have_any_leading_dimensions_map_and_have_gradients(noise: float | None) -> None:
    scene = Scene(robot_of(ANYMAL), FEET, 15, samples=6)
    project = Projection([True] * 9 + [False] * 3, [True] * 3 + [False] * 9, 6, noise, noise, noise)
    batch = (scene.J, scene.active, scene.K, scene.torque, scene.wrench)
    padded = project(*batch, pad=True)
    split = project(*(x.unflatten(0, (2, 3)) for x in batch), pad=True)
    single = project(*(x[4] for x in batch), pad=True)

    def squares(*part: Tensor) -> Tensor:
        group = project(*part, pad=True)
        return (group.K.mean(-1) - group.f).square().sum(-1)

    assert split.index.shape == (2, 3)
    for name in ("V", "K", "f"):
        found = getattr(padded, name)
        torch.testing.assert_close(getattr(split, name).flatten(0, 1), found)
        torch.testing.assert_close(getattr(single, name), found[4])
    torch.testing.assert_close(torch.func.vmap(squares)(*batch), squares(*batch))
    J = scene.J.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda J: squares(J, *batch[1:]), J, atol=1e-5, rtol=1e-6, fast_mode=True)
    by_groups = Scene.project(scene, project)
    total = sum((group.K.mean(2) - group.f).square().sum() for group in by_groups)
    torch.testing.assert_close(squares(*batch).sum(), total)


def test_memory_of_a_padded_projection_is_written_again() -> None:
    scene, other = (Scene(robot_of(ANYMAL), FEET, seed) for seed in (16, 17))
    project = Projection([True] * 12, [False] * 12)
    out = scene.project(project, pad=True)
    addresses = [x.data_ptr() for x in (out.V, out.K, out.f)]
    again = project(other.J, other.active, other.K, other.torque, other.wrench, pad=True, out=out)
    assert [x.data_ptr() for x in (again.V, again.K, again.f)] == addresses
    expected = other.project(project, pad=True)
    for name in ("V", "K", "f", "active"):
        assert torch.equal(getattr(again, name), getattr(expected, name))
    fewer = [x[:5] for x in (other.J, other.active, other.K, other.torque, other.wrench)]
    with pytest.raises(ValueError, match=r"out.V: found \(12, 18, 18\) torch.float64; accepted: \(5, 18, 18\)"):
        project(*fewer, pad=True, out=out)


@pytest.mark.parametrize("noise", [None, 0.5], ids=["orthonormal", "whitened"])
def test_a_missing_number_stays_in_its_sample(noise: float | None) -> None:
    scene = Scene(robot_of(ANYMAL), FEET, 18)
    scene.touching[:] = True
    project = Projection([True] * 12, [False] * 12, 6, noise, noise, noise)
    expected = scene.project(project, pad=True)
    scene.J[3, 2, 8] = torch.nan
    found = scene.project(project, pad=True)
    good = torch.arange(12) != 3
    assert found.K[3].isnan().all()
    torch.testing.assert_close(found.K[good].mT @ found.K[good], expected.K[good].mT @ expected.K[good])


SOLOS_FEET = [Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR")]


def test_each_straight_knee_hides_one_direction_of_the_base_from_the_torques() -> None:
    """A force in the plane of hip and straight knee, along the leg, does no work on the leg's joints."""
    scene = Scene(robot_of(SOLO12), SOLOS_FEET, 7, samples=16)
    scene.touching[:] = True
    rng = np.random.default_rng(7)
    straight = torch.from_numpy(rng.random((16, 4)) < 0.5)
    scene.q[:, [9, 12, 15, 18]] *= ~straight  # the knees
    found = {}
    for group in check(scene, np.ones(12, bool), np.zeros(12, bool)):
        found |= dict(zip(group.index.tolist(), group.base_rank.tolist(), strict=True))
    assert [found[sample] for sample in range(16)] == (6 - straight.sum(1)).tolist()
    assert len(set(found.values())) > 3
