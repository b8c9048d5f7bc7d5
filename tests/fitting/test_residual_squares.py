"""Squares of residuals of samples, and of the factors that these are compressed to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from repository import DEMO
from synthetic import SOLO12, Oracle, load, make_log

from torchid.config import load_config
from torchid.fitting.calibration import Calibration
from torchid.fitting.cross_validation import residuals_of_samples, sum_residuals, with_all_readings
from torchid.fitting.experiment import set_up
from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, bind_log, compress_parts
from torchid.sensing import Contact, named_sensors

pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")


@pytest.mark.parametrize("sensors", ["joints", "contacts", "full"])
@pytest.mark.parametrize("offsets", [False, True])
def test_residuals_of_samples_are_those_of_their_factors(sensors: str, offsets: bool) -> None:
    overrides = [f"sensors.set={sensors}"]
    if offsets:
        overrides += ["sensors.offsets=log"]
    experiment = set_up(load_config(DEMO / "quadruped.yaml", overrides))
    log = preprocess(read_log(DEMO / "sway_train.npz"), 8.0)
    whole = bind_log(log, experiment.robot, experiment.contacts)
    logs = [whole[:700], replace(whole[900:1500], source="other")]
    builder, rng = experiment.builder(experiment.sensors), np.random.default_rng(0)
    values = {("" if not x.per_log else one.source, x.label): rng.normal() for x in builder.extras for one in logs}
    nominal = experiment.robot.nominal.flatten()
    compared = [
        Calibration(robot=experiment.robot, builder=builder, phi=scale * nominal, values=values) for scale in (1.0, 1.3)
    ]
    assert bool(builder.extras) == offsets
    expected = sum_residuals(builder, logs, compress_parts(logs, builder), compared)
    for found, one in zip(residuals_of_samples(builder, logs, compared), expected, strict=True):
        assert found.rows == one.rows
        assert found.noise == pytest.approx(one.noise, rel=1e-12)
        assert found.measured == pytest.approx(one.measured, rel=1e-10)
        assert found.error == pytest.approx(one.error, rel=1e-10)
    assert expected[0].error != pytest.approx(expected[1].error, rel=1e-3)


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
