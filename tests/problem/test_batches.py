"""Mini-batches: the same equations as the compressed problem's, every sample once per epoch, mixed and reproducible."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from random_samples import random_samples, sensor_set
from simulated import BIPED, QUADRUPED
from synthetic import DRONE, G1, PANDA, TALOS_FULL, Array, load
from torch import Tensor

from torchid.problem import Batch, MiniBatches, RowBuilder, Samples, compress, linear_problem
from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot
from torchid.sensing import Contact

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
KINDS = {
    "G1": (G1, None, False, [Contact(f"{side}_ankle_roll_link", "flat") for side in ("left", "right")]),
    "biped": (BIPED, None, False, [Contact("l_sole", "flat"), Contact("r_sole", "line", "x")]),
    "quadruped": (QUADRUPED, None, False, [Contact(f"{leg}_foot", "point") for leg in LEGS]),
    "mimic fingers": (TALOS_FULL, None, False, [Contact("left_sole_link", "flat"), Contact("right_sole_link", "flat")]),
    "bolted arm": (PANDA, None, True, [Contact("panda_rightfinger", "point"), Contact("panda_hand", "line")]),
    "bolted arm in free motion": (PANDA, None, True, []),
    "drone": (DRONE, None, False, [Contact("base_link", "flat"), Contact("base_link", "point")]),
}
CASES = [
    *(("G1", "full"), ("biped", "contacts"), ("quadruped", "joints"), ("quadruped", "mixed")),
    *(("mimic fingers", "mixed"), ("bolted arm", "full"), ("bolted arm", "mixed")),
]
cases = pytest.mark.parametrize(("kind", "sensors"), CASES, ids=[" ".join(case) for case in CASES])


@dataclass(frozen=True)
class World:
    """A robot with its sensors, and two logs, one with wrenches along world axes if the base floats."""

    robot: Robot
    contacts: list[Contact]
    builder: RowBuilder
    logs: list[Samples]

    def random_phi(self, seed: int) -> Array:
        """Parameters (12 L,) of no robot; the base has no friction."""
        phi = np.random.default_rng(seed).normal(size=self.robot.nominal.shape)
        phi[0, 10:] = 0.0
        return phi.flatten()


@cache
def world(kind: str, sensors: str, samples: tuple[int, ...] = (30, 21)) -> World:
    urdf, base_link, fixed_base, contacts = KINDS[kind]
    robot = load(urdf, base_link, fixed_base)
    turned = (False, not fixed_base)
    logs = [random_samples(robot, contacts, n, k, turned[k % 2], states=3)[0] for k, n in enumerate(samples)]
    return World(robot, contacts, RowBuilder(robot, contacts, sensor_set(sensors, robot, contacts)), logs)


@cache
def many() -> World:
    """Three logs of a drone, whose rows are cheap, in four contact states: enough samples for two chunks."""
    w = world("drone", "full", (620, 1, 410))
    for log in w.logs:
        log.active[:] = torch.arange(len(log))[:, None] // torch.tensor([1, 2]) % 2 == 0
    return w


TOTAL = 1031


def marks(log: Samples) -> list[float]:
    """What tells the samples of a log apart: an acceleration."""
    return log.coordinates()[2][:, -1].tolist()


def keys(batch: Batch) -> list[float]:
    """The same of a batch."""
    return batch.a[:, -1].tolist()


def order(batches: MiniBatches, epoch: int) -> list[float]:
    return [key for batch in batches.epoch(epoch) for key in keys(batch)]


def equal(one: Batch, other: Batch) -> bool:
    """Bit for bit."""
    return all(torch.equal(x, y) for x, y in zip(vars(one).values(), vars(other).values(), strict=True))


# ------------------------------------------------------------------------------------------------------------- epochs


@pytest.mark.parametrize("batch_size", [1, 7, 256, 1000, 5000])
def test_an_epoch_has_every_sample_of_every_log_once(batch_size: int) -> None:
    w = many()
    batches = MiniBatches(w.logs, w.builder, batch_size)
    expected = Counter(key for log in w.logs for key in marks(log))
    assert set(expected.values()) == {1}
    assert batches.samples == TOTAL
    for epoch in (1, 2):
        assert Counter(order(batches, epoch)) == expected
    assert Counter(key for batch in batches.chunks() for key in keys(batch)) == expected


def test_the_order_depends_on_the_seed_and_the_number_of_the_epoch_and_nothing_else() -> None:
    w = many()
    torch.manual_seed(1)
    first = MiniBatches(w.logs, w.builder, 64, seed=5)
    orders = {epoch: order(first, epoch) for epoch in (1, 2, 3)}
    torch.manual_seed(2)
    before = torch.get_rng_state()
    again = MiniBatches(w.logs, w.builder, 64, seed=5)
    assert order(again, 3) == orders[3], "whatever epochs were asked for before"
    assert order(again, 1) == orders[1]
    assert order(again, 1) == orders[1]
    assert torch.equal(torch.get_rng_state(), before)
    assert orders[1] != orders[2] != orders[3]
    for seed in (0, 4, 6):
        assert order(MiniBatches(w.logs, w.builder, 64, seed=seed), 1) not in orders.values()


@pytest.mark.parametrize("memory", [0, 500_000, 10**9])
def test_rows_are_the_same_to_the_last_bit_whether_kept_or_computed_anew(
    memory: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    w = many()
    expected = [list(MiniBatches(w.logs, w.builder, 256, memory=0).epoch(epoch)) for epoch in (1, 2)]
    computed = []
    plain = RowBuilder.rows_by_sample
    monkeypatch.setattr(RowBuilder, "rows_by_sample", lambda *a: computed.append(len(a[1])) or plain(*a))
    batches = MiniBatches(w.logs, w.builder, 256, memory=memory)
    counts = []
    for epoch in (1, 2):
        computed.clear()
        for batch, other in zip(batches.epoch(epoch), expected[epoch - 1], strict=True):
            assert equal(batch, other)
        counts.append(sum(computed))
    kept = [TOTAL - count for count in counts]
    if memory == 0:
        assert kept == [0, 0]
    elif memory == 10**9:
        assert kept == [0, TOTAL]
    else:
        assert kept[0] == 0
        assert 0 < kept[1] < TOTAL
        size = sum(batch.nbytes for batch in batches.chunks()) / TOTAL
        assert kept[1] * size <= memory


def test_a_batch_of_no_samples_is_refused() -> None:
    w = many()
    with pytest.raises(ValueError, match="batch_size: found 0; accepted: at least 1"):
        MiniBatches(w.logs, w.builder, 0)


# ------------------------------------------------------------------------------------------------ shares and held out


@pytest.mark.parametrize("size", [2, 3])
def test_processes_that_share_batches_have_each_sample_of_a_batch_once(size: int) -> None:
    """Of a chunk of one sample, all but one have none."""
    w = world("drone", "full", (1, 40))
    for batch_size in (1, 7):
        alone = MiniBatches(w.logs, w.builder, batch_size)
        shares = [MiniBatches(w.logs, w.builder, batch_size, share=(rank, size)) for rank in range(size)]
        for whole, *parts in zip(alone.epoch(2), *(batches.sized_epoch(2) for batches in shares), strict=True):
            assert [count for _, count in parts] == [len(whole)] * size
            assert Counter(key for part, _ in parts for key in keys(part)) == Counter(keys(whole))
        for whole, *parts in zip(alone.chunks(), *(batches.sized_chunks() for batches in shares), strict=True):
            assert [count for _, count in parts] == [len(whole)] * size
            assert max(len(part) for part, _ in parts) - min(len(part) for part, _ in parts) <= 1
            assert Counter(key for part, _ in parts for key in keys(part)) == Counter(keys(whole))


# --------------------------------------------------------------------------------------------------------------- rows


@cases
def test_squared_residuals_of_an_epoch_add_up_to_the_compressed_problems_cost(kind: str, sensors: str) -> None:
    w = world(kind, sensors)
    problem = linear_problem(compress(w.logs, w.builder), w.builder, w.robot)
    batches = MiniBatches(w.logs, w.builder, 8, seed=1)
    for seed in range(3):
        phi = w.random_phi(seed)
        total, rows = 0.0, 0
        for batch in batches.epoch(seed + 1):
            misfit = batch.K @ (batches.columns @ torch.from_numpy(phi)) - batch.f
            total, rows = total + float(misfit.square().sum()), rows + batch.rows
        assert rows == problem.rows
        assert total == pytest.approx(problem.cost(phi), rel=1e-12)


def dense(w: World, log: Samples, phi: Array) -> Tensor:
    """K phi, (B, nv), by the regressor at the samples' coordinates."""
    return Regressor(w.robot)(*log.coordinates()) @ torch.from_numpy(phi)


def pushed(w: World, log: Samples) -> Tensor:
    """S^T tau + J_C^T lambda, (B, nv), of all recorded forces, by frame Jacobians."""
    q, _, _ = log.coordinates()
    force = torch.nn.functional.pad(log.torque, (w.robot.base_rows, 0))
    for place, contact in enumerate(w.contacts):
        wrench = log.wrench[:, place]
        if log.wrench_in_world:
            poses = w.robot.link_poses(log.joint_position)
            R = log.base.rotation @ poses[contact.frame][:, :3, :3]
            wrench = (wrench.unflatten(1, (2, 3)) @ R).flatten(1)
        used = list(contact.components)
        pushing = (wrench * log.active[:, place, None])[:, used]
        force += (FrameJacobian(w.robot, contact.frame)(q)[:, used].mT @ pushing[..., None])[..., 0]
    return force


@cases
def test_rows_are_projections_of_the_dense_regressor_and_of_all_forces(kind: str, sensors: str) -> None:
    """W kills what is not measured: projecting every recorded force gives what the measured ones alone gave."""
    w, phi = world(kind, sensors), world(kind, sensors).random_phi(7)
    predicted, measured = {}, {}
    for log in w.logs:
        predicted |= dict(zip(marks(log), dense(w, log, phi), strict=True))
        measured |= dict(zip(marks(log), pushed(w, log), strict=True))
    batches = MiniBatches(w.logs, w.builder, 16)
    for batch in batches.epoch(1):
        W = batch.W.mT
        for found, force in ((batch.K @ (batches.columns @ torch.from_numpy(phi)), predicted), (batch.f, measured)):
            force = torch.stack([force[key] for key in keys(batch)])
            expected = (W @ force[..., None])[..., 0]
            size = float((W.norm(dim=2) * force.norm(dim=1, keepdim=True)).max())
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13 * size)


def test_forces_of_parameters_are_those_of_the_dense_regressor_log_by_log() -> None:
    """Of more samples than are worked out at once, too."""
    w = world("drone", "full", (1100, 3))
    phi = w.random_phi(9)
    found = list(MiniBatches(w.logs, w.builder).generalized_forces(phi))
    for number in range(3):
        expected = torch.cat([log.coordinates()[number] for log in w.logs])
        assert torch.equal(torch.cat([coordinates[number] for coordinates, _ in found]), expected)
    force, expected = torch.cat([force for _, force in found]), torch.cat([dense(w, log, phi) for log in w.logs])
    assert float((force - expected).abs().max()) <= 1e-13 * float(expected.abs().max())
