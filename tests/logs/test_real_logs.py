"""Logs of people and robots, recorded by others."""

from __future__ import annotations

import numpy as np
import pytest
from repository import SHARED

from torchid.logs import read_log


def test_the_real_logs_read_and_weigh_what_they_should() -> None:
    if not SHARED.is_dir():
        pytest.skip(f"no real logs at {SHARED}")
    static = read_log(SHARED / "human_squats" / "static1.npz")
    assert static.contact_wrench_world is not None
    force = static.contact_wrench_world[:, :, :3].sum(axis=1).mean(axis=0)
    assert np.linalg.norm(force) / 9.81 == pytest.approx(60.03, rel=2e-3)  # a person does not stand quite still
    assert read_log(SHARED / "kuka_lwr4" / "run1.npz").joint_torque is not None
