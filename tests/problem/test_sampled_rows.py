"""Rows of a sample of the logs, when only what friction goes with changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.problem import ExtraTerms, RowBuilder, bind_log
from torchid.problem.sampled_rows import SampledRows
from torchid.sensing import named_sensors


@pytest.mark.parametrize("fixed_base", [False, True], ids=["floating", "bolted"])
@pytest.mark.parametrize("width", [None, 0.1])
def test_rows_with_other_directions_are_those_made_anew(fixed_base: bool, width: float | None, tmp_path: Path) -> None:
    """Of a robot with joints that mimic others; directions that a log has, and those that follow from a width."""
    robot, rng = load(machine(tmp_path), None, fixed_base, SENSORS), np.random.default_rng(0)
    contacts = [(contact.frame, contact.components) for contact in CONTACTS]
    log = bind_log(make_log(Oracle.of(robot), contacts, STATES, 24, rng), robot, CONTACTS)
    sensors = named_sensors("full", robot.n, len(CONTACTS), ft=len(SENSORS))
    builder, smooth = (RowBuilder(robot, CONTACTS, sensors, ExtraTerms(sign_width=x)) for x in (None, width))
    of_one = SampledRows([replace(log, direction=torch.ones_like(log.joint_velocity))], builder)
    recorded = torch.from_numpy(rng.uniform(-1.0, 1.0, log.joint_velocity.shape))
    for direction in (None, recorded):
        other = [replace(log, direction=direction)]
        found, anew = of_one.with_directions(other, smooth), SampledRows(other, smooth)
        for own, expected, before in zip(found.chunks, anew.chunks, of_one.chunks, strict=True):
            assert not torch.equal(expected.rows, before.rows)
            np.testing.assert_allclose(own.rows, expected.rows, rtol=1e-14, atol=1e-14)
