"""Which sensors make predictions of the others worse, by fits that leave them and blocks of the log out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import Oracle, make_log

import torchid
from torchid.fitting.left_out import gain_deviations, leave_sensors_out
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.compression import compress_parts
from torchid.report.analysis import ALL_OF, contradicting_messages
from torchid.sensing import SensorNoise, SensorSet, named_sensors

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
NOISE = SensorNoise(joint_torque=0.1, contact_force=0.5, base_force=0.5, base_moment=0.1)
FULL = named_sensors("full", ROBOT.n, len(FEET), NOISE)


def walk(gain: float) -> Samples:
    """A log with noise in which the second foot reads `gain` times its force."""
    rng = np.random.default_rng(0)
    oracle = Oracle.of(ROBOT)
    oracle.perturb(rng, 0.1)
    walks = [[True] * 4, [True, False, False, True], [False, True, True, False]]
    log = make_log(oracle, [(foot.frame, 3) for foot in FEET], walks, 400, rng, tilt=0.2)
    force = log.contact_wrench_local + 0.5 * rng.normal(size=log.contact_wrench_local.shape)
    force[:, 1] *= gain
    torque = log.joint_torque + 0.1 * rng.normal(size=log.joint_torque.shape)
    return bind_log(replace(log, joint_torque=torque, contact_wrench_local=force), ROBOT, FEET)


def without_foot(number: int) -> SensorSet:
    wrench = FULL.wrench.copy()
    wrench[number] = False
    return replace(FULL, wrench=wrench)


def fitter_of(terms: ExtraTerms, sensors: SensorSet = FULL) -> torchid.LogFitter:
    builder = RowBuilder(ROBOT, FEET, sensors, terms)
    return torchid.LogFitter(robot=ROBOT, builder=builder, estimator=torchid.LeastSquares(ridge=1e-3))


@pytest.mark.parametrize("terms", [ExtraTerms(), ExtraTerms(offsets={"contact_force": "all"})], ids=["", "offsets"])
def test_the_foot_that_reads_too_much_is_found_and_no_other(terms: ExtraTerms) -> None:
    sets = {foot.frame: without_foot(number) for number, foot in enumerate(FEET)}
    sets[f"{ALL_OF}contact"] = named_sensors("joints", ROBOT.n, len(FEET), NOISE)
    found = leave_sensors_out([walk(1.3)], fitter_of(terms), terms, sets)
    assert [name for name in sets if found[name].adopted] == [FEET[1].frame, f"{ALL_OF}contact"]
    first, kind = contradicting_messages(found)
    assert first.startswith(f"Without {FEET[1].frame} the error of the other sensors is ")
    assert kind.startswith(f"Without {ALL_OF}contact ")
    clean = leave_sensors_out([walk(1.0)], fitter_of(terms), terms, sets)
    assert not any(one.adopted for one in clean.values())
    assert not contradicting_messages(clean)


@pytest.mark.parametrize("scope", ["all", "log"])
def test_errors_of_gains_move_parameters_where_scales_of_contact_forces_are_fitted(scope: str) -> None:
    terms = ExtraTerms(scales={"contact_force": scope})
    fitter = fitter_of(terms)
    log = walk(1.0)
    deviations = gain_deviations([log], fitter, terms, 0.01)
    assert deviations.shape == (ROBOT.n, ROBOT.nominal.size)
    before = fitter.fit(compress_parts([log], fitter.builder)).estimate.phi
    gained = log.torque.clone()
    gained[:, 1] *= 1.01
    after = fitter.fit(compress_parts([replace(log, torque=gained)], fitter.builder)).estimate.phi
    np.testing.assert_allclose(deviations[1], after - before, atol=0.01 * np.abs(after - before).max())
