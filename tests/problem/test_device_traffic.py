"""What compression lets a GPU and the host say to each other: one decision for a chunk, and nothing else.

No GPU is needed: tensors without values stand for those on one, see `device_traffic`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from device_traffic import DEVICE, DeviceTraffic
from random_samples import random_samples, sensor_set
from synthetic import G1, PANDA, SOLO12, load
from thinned import SLOW
from torch import Tensor
from welded import CONTACTS, SENSORS, machine

from torchid.problem import ExtraTerms, RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.compression import Part, _compress_chunks
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import CHANNELS
from torchid.sensing import Contact, SensorSet, with_ft_sensors

DECISION = "sensing/projection.py, any_suspect: _local_scalar_dense (a number)"
CHUNK = 32
LEGS = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
SOLES = tuple(Contact(f"{side}_ankle_roll_link", "flat") for side in ("left", "right"))
BALLS = tuple(replace(contact, radius=0.03) for contact in LEGS)
ROBOTS = {"quadruped": (SOLO12, False, LEGS), "balls": (SOLO12, False, BALLS), "humanoid": (G1, False, SOLES),
          "bolted arm": (PANDA, True, (Contact("panda_hand", "line", "x"),)),
          "sensors in limbs": (None, False, CONTACTS)}  # fmt: skip
TERMS = ExtraTerms(
    offsets=dict.fromkeys(CHANNELS, "log"),
    scales=dict.fromkeys(CHANNELS[1:3], "all"),
    armature=True,
    torque_offset=True,
    asymmetric_coulomb=True,
    stiffness=True,
    sign_width=0.05,
)
Chunks = Sequence[tuple[Samples, ContactState]]


def chunks_of(name: str, sensors: str, world: bool, terms: ExtraTerms, folder: Path) -> tuple[RowBuilder, Chunks]:
    """Chunks of a log with three contact states, with readings in the air, where one is after some time."""
    urdf, bolted, contacts = ROBOTS[name]
    robot = load(urdf or machine(folder), None, bolted, () if urdf else SENSORS)
    samples, _ = random_samples(robot, contacts, 4 * CHUNK, 1, world, states=3)
    limbs = robot.n_dofs - robot.n
    torque = torch.cat([samples.torque, torch.ones(len(samples), limbs, dtype=torch.float64)], dim=1)
    in_the_air = torch.where(samples.active[..., None], torch.nan, samples.wrench)
    samples = replace(samples, torque=torque, unloaded=in_the_air)
    chosen = sensor_set(sensors, robot, contacts)
    if limbs:
        chosen = SensorSet(np.append(chosen.torque[: robot.n], np.zeros(limbs, bool)), chosen.wrench, chosen.noise)
        chosen = with_ft_sensors(chosen, robot, SENSORS)
    builder = RowBuilder(robot, contacts, chosen, terms)
    return builder, [(samples[index], state) for state, index in chunks_by_state(samples, CHUNK)]


def traffic(builder: RowBuilder, chunks: Chunks) -> dict[str, int]:
    """What passes between the device and the host in chunks whose contact states are known already."""
    builder = builder.to(DEVICE)
    there = [(samples.to(DEVICE), state) for samples, state in chunks]

    def compress() -> list[Part]:
        return _compress_chunks(builder, iter(there), None)

    with torch.no_grad(), DeviceTraffic() as mode:
        compress()
        mode.found.clear()
        compress()
    return dict(mode.found)


@pytest.mark.parametrize(
    ("name", "sensors", "world", "terms"),
    [
        pytest.param("quadruped", "joints", False, ExtraTerms(), marks=SLOW),
        pytest.param("quadruped", "full", False, TERMS, marks=SLOW),
        pytest.param("quadruped", "mixed", True, ExtraTerms(), marks=SLOW),
        pytest.param("humanoid", "joints", False, TERMS, marks=SLOW),
        ("humanoid", "contacts", True, ExtraTerms()),
        ("bolted arm", "joints", False, ExtraTerms()),
        pytest.param("bolted arm", "mixed", True, TERMS, marks=SLOW),
        ("sensors in limbs", "mixed", True, TERMS),
    ],
)
def test_the_host_waits_for_one_decision_in_each_chunk_and_copies_nothing(
    name: str, sensors: str, world: bool, terms: ExtraTerms, tmp_path: Path
) -> None:
    builder, chunks = chunks_of(name, sensors, world, terms, tmp_path)
    unmeasured = [any(len(body.unmeasured) for body in builder.layout(state).contact_bodies) for _, state in chunks]
    expected = {DECISION: sum(unmeasured)} if any(unmeasured) else {}
    assert traffic(builder, chunks) == expected


@pytest.mark.parametrize(
    ("name", "sensors"), [("quadruped", "joints"), pytest.param("bolted arm", "mixed", marks=SLOW)]
)
def test_where_joints_rest_the_host_waits_for_the_rows_of_each_state_at_the_end(
    name: str, sensors: str, tmp_path: Path
) -> None:
    builder, chunks = chunks_of(name, sensors, False, ExtraTerms(), tmp_path)
    rng = np.random.default_rng(0)
    resting = [torch.from_numpy(rng.random(samples.joint_position.shape) < 0.3) for samples, _ in chunks]
    with_rest = [(replace(samples, resting=own), state) for (samples, state), own in zip(chunks, resting, strict=True)]
    states = len({state for _, state in chunks})
    more = {"problem/compression.py, close: _local_scalar_dense (a number)": states}
    assert traffic(builder, with_rest) == traffic(builder, chunks) | more


def test_a_state_that_is_met_for_the_first_time_costs_a_few_copies_once(tmp_path: Path) -> None:
    """Indices and constants; and the test above sees them, were they made again in every chunk."""
    builder, chunks = chunks_of("quadruped", "joints", True, ExtraTerms(), tmp_path)
    builder = builder.to(DEVICE)
    there = [(samples.to(DEVICE), state) for samples, state in chunks]
    with torch.no_grad(), DeviceTraffic() as mode:
        _compress_chunks(builder, iter(there), None)
    del mode.found[DECISION]
    assert 0 < sum(mode.found.values()) < 100


def x(*shape: int) -> Tensor:
    return torch.ones(shape, dtype=torch.float64, device=DEVICE)


@pytest.mark.parametrize(
    ("do", "found"),
    [
        (lambda: bool(x(3).any()), "_local_scalar_dense (a number)"),
        (lambda: float(x(3).sum()), "_local_scalar_dense (a number)"),
        (lambda: x(3)[0].item(), "_local_scalar_dense (a number)"),
        (lambda: x(3) + torch.ones(3), "add of tensors here and there"),
        (lambda: x(3).to("cpu"), "_to_copy of tensors here and there"),
        (lambda: torch.ones(3).to(DEVICE), "_to_copy of tensors here and there"),
        (lambda: x(3).copy_(torch.ones(3)), "copy_ of tensors here and there"),
        (lambda: x(3).cpu(), "cpu (a copy to the host)"),
        (lambda: torch.tensor([1.0], device=DEVICE), "tensor (a copy to the device)"),
        (lambda: torch.tensor([1.0], device="meta"), "tensor (a copy to the device)"),
        (lambda: x(3).new_tensor([1.0]), "new_tensor (a copy to the device)"),
        (lambda: x(3, 3)[:, [0, 1]], "index by a list (a copy to the device)"),
        (lambda: x(3)[torch.tensor([0])], "index of tensors here and there"),
        (lambda: x(3)[x(3) > 0], "index by a mask (a shape)"),
        (lambda: torch.nonzero(x(3)), "nonzero (a shape)"),
        (lambda: torch.equal(x(3), x(3)), "equal (a decision)"),
        (lambda: torch.unique(x(3)), "_unique2 (a shape)"),
        (lambda: torch.linalg.cholesky(x(3, 3)), "_linalg_check_errors (a verdict on a factorization)"),
        (
            lambda: torch.linalg.cholesky_ex(x(3, 3), check_errors=True),
            "linalg_cholesky_ex (a verdict on a factorization)",
        ),
        (lambda: torch.linalg.svd(x(3, 3)), "_linalg_svd (convergence)"),
    ],
)
def test_every_kind_of_exchange_is_seen(do: Callable[[], object], found: str) -> None:
    with DeviceTraffic() as mode, suppress(RuntimeError):  # what has no values cannot be asked for one
        do()
    assert f"tests: {found}" in mode.found


def test_what_stays_on_the_device_is_not_counted() -> None:
    with DeviceTraffic() as mode:
        a = x(4, 3)
        index = torch.arange(2, device=DEVICE)
        _ = (a * 2.0 + a[:, :1]).sum(0).clamp_min(0.0), a[index], torch.zeros_like(a), a.new_zeros(3), a[..., 1:]
        torch.linalg.cholesky_ex(a.mT @ a)
        a[0] = 1.0
    assert not mode.found
