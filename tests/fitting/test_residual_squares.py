"""Which samples of a log count where errors are compared that some of its readings lack."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import SOLO12, Oracle, load, make_log

from torchid.fitting.left_out import with_all_readings
from torchid.problem import RowBuilder, bind_log
from torchid.sensing import Contact, named_sensors

pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")


def test_samples_without_a_reading_are_left_out_of_the_residual() -> None:
    robot, contacts = load(SOLO12), [Contact("FL_FOOT", "point")]
    log = make_log(Oracle.of(robot), [("FL_FOOT", 3)], [(True,), (False,)], 20, np.random.default_rng(0))
    samples = bind_log(log, robot, contacts)
    assert samples.torque is not None
    assert samples.wrench is not None
    samples.torque[3, 2] = np.nan
    samples.wrench[4, 0, 1] = samples.wrench[5, 0, 1] = np.nan  # 5: in the air
    for name, lost in (("full", {3, 4}), ("joints", {3}), ("contacts", {4})):
        found = with_all_readings(samples, RowBuilder(robot, contacts, named_sensors(name, robot.n, 1)))
        assert set(range(20)) - {samples.time.tolist().index(t) for t in found.time.tolist()} == lost
    silent = replace(samples, torque=None)
    assert len(with_all_readings(silent, RowBuilder(robot, contacts, named_sensors("joints", robot.n, 1)))) == 0
