"""The zeros of coupled rows. That nothing else is left out, `test_rows_against_oracle.py` checks against Pinocchio."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from random_samples import random_samples, sensor_set

import torchid
from torchid.problem import RowBuilder, TriangularFactor
from torchid.problem.null_bases import triangularize_base_rows

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
DIAGONAL = (True, False, False, True)  # front left, rear right


def test_a_foot_that_the_ground_holds_is_in_no_combination_of_rows() -> None:
    sole = torchid.Contact(FEET[0].frame, "flat")
    builder = RowBuilder(ROBOT, [sole], sensor_set("joints", ROBOT, [sole]))
    layout, held = builder.columns.layout, builder.frames[0][0]
    of_held = set(range(layout.starts[held], layout.starts[held + 1]))
    (block,) = builder.layout((True,)).blocks.of_rank(3)
    assert set(range(layout.count)) - set(block.inertial) == of_held
    samples, _ = random_samples(ROBOT, [sole], 30, 3, states=1)
    W = builder.rows_by_sample(samples, (True,))[1][:, :, block.rows]
    twists = builder.contact_jacobian(samples)[:, 0] @ W  # of the foot, in the motions whose virtual work the rows are
    assert 0.0 < twists.abs().max() < 1e-12 * W.abs().max()


@pytest.mark.parametrize("sensors", ["full", "contacts", "joints", "mixed"])
def test_the_basis_is_zero_where_blocks_say_so(sensors: str) -> None:
    samples, _ = random_samples(ROBOT, FEET, 30, 3, states=1)
    for state in (DIAGONAL, (True,) * 4, (True, False, False, False), (False,) * 4):
        builder = RowBuilder(ROBOT, FEET, sensor_set(sensors, ROBOT, FEET))
        _, W = builder.rows_by_sample(samples, state)
        layout = builder.layout(state)
        rank = 6 + len(layout.coupled_joints) - sum(body.count for body in layout.contact_bodies)
        W = W / W.abs().amax(dim=(0, 1))
        for block in layout.blocks.of_rank(rank):
            own = W[..., block.rows]
            if block.base != "all":
                assert own[:, 3:6].abs().sum() < 1e-11
            if block.base == "none":
                assert own[:, :6].abs().sum() < 1e-11
            combined = {layout.coupled_joints[joint] for _, joint, _, _ in block.moved}
            others = [6 + joint for joint in range(ROBOT.n) if joint not in combined]
            assert own[:, others].abs().sum() < 1e-11


@pytest.mark.parametrize("r", [1, 2, 3, 5, 6, 9])
def test_turned_bases_span_what_they_did(r: int) -> None:
    W = torch.randn(15, r, 40, generator=torch.Generator().manual_seed(r), dtype=torch.float64)
    W[:6, :, 0] = 0.0  # no part in the base at all
    W[3:6, :, 1] = 0.0
    W[3:6, :, 2] = W[3, :, 2]  # moments of one direction
    turned = W.clone()
    triangularize_base_rows(turned)
    square, turned_square = (torch.einsum("irb,jrb->bij", x, x) for x in (W, turned))
    torch.testing.assert_close(turned_square, square, rtol=0.0, atol=1e-13 * float(square.abs().max()))
    assert turned[3:6, : max(r - 3, 0)].abs().sum() < 1e-12
    assert turned[:6, : max(r - 6, 0)].abs().sum() < 1e-12


def test_rows_with_room_above_are_added_as_any() -> None:
    rng = torch.Generator().manual_seed(0)
    support, columns = (0, 2, 3), 5
    plain, in_place = TriangularFactor(columns), TriangularFactor(columns)
    for count in (2, 1, 20, 2, 50):  # fewer rows than columns as well
        rows = torch.randn(count, 4, generator=rng, dtype=torch.float64)
        stacked = torch.full((4, 4 + count), torch.nan, dtype=torch.float64).T  # whatever is above
        stacked[4:] = rows
        plain.add(support, rows, 2.0)
        in_place.add_in_place(support, stacked, 2.0)
        both = plain.triangle(), in_place.triangle()
        torch.testing.assert_close(both[0].T @ both[0], both[1].T @ both[1], rtol=1e-13, atol=1e-13)
    assert (in_place.rows, in_place.oversampling) == (plain.rows, plain.oversampling) == (75, 2.0)
