"""Whether a model explains the forces: by the noise that is stated, and by residuals that are alike."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from repository import DEMO
from synthetic import UR5

import torchid
from torchid.cli import main
from torchid.config.experiment import ActuatorsConfig
from torchid.fitting.noise import (
    GroupNoise,
    Misfit,
    UnfittedFriction,
    resting_joints,
    unfitted_friction,
)
from torchid.parameters import FRICTION
from torchid.problem import ExtraTerms, bind_log

UNITS = (("N m", "N m s/rad"), ("N", "N s/m"))
UNPHYSICAL = "ignore::torchid.errors.TorchidWarning"


def test_a_model_explains_what_noise_would_leave_and_no_more() -> None:
    good = Misfit(residual=0.33, expected=0.32, lack_of_fit=1.1, error_growth=1.0, groups=())
    assert good.explained
    assert str(good) == ""
    torque = GroupNoise("joint_torque", "N m", "stated", 0.5, 0.4)
    more = replace(good, residual=0.8, groups=(torque,))
    assert not more.explained
    assert str(more) == (
        "residuals are 2.5 times as large as the stated noise; most in joint_torque 0.4 N m (expected 0.16)"
    )
    assert replace(more, expected=None).explained, "estimated noise is what the residuals show"
    alike = replace(good, expected=None, lack_of_fit=4.0)
    assert not alike.explained
    assert str(alike) == "residuals are not white (their block variance is 4 times that of noise)"
    assert replace(alike, lack_of_fit=None).explained
    assert replace(alike, share=1e-7).explained, "what rounding leaves of exact signals"
    assert not replace(alike, share=1e-5).explained
    friction = UnfittedFriction(("knee", "slide"), np.array([[0.1, 0.02], [3.0, -1.0]]), UNITS, 40.0, 4)
    unfitted = replace(good, friction=friction)
    assert not unfitted.explained
    assert str(unfitted) == (
        "friction, which is not fitted, explains 40 times as much as noise would"
        " (knee 0.1 N m and 0.02 N m s/rad, slide 3 N and -1 N s/m)"
    )
    assert replace(good, friction=replace(friction, ratio=1.9)).explained
    assert replace(good, friction=replace(friction, ratio=4.5)).explained, "one in a thousand of noise, of so few"


def noise_and_friction(level: float, count: int) -> list[UnfittedFriction]:
    """Fits without friction of forces of an arm with so much of it, one in three readings independent."""
    arm, rng = torchid.load_robot(UR5, fixed_base=True), np.random.default_rng(3)
    builder = torchid.RowBuilder(arm, [], torchid.named_sensors("joints", arm.n, 0, torchid.SensorNoise(0.3, 1.0, 0.1)))
    t = np.arange(400) / 100.0
    phase, pace = rng.uniform(0.0, 6.0, arm.n), rng.uniform(3.0, 9.0, arm.n)
    q, v, a = (0.5 * pace**k * np.sin(pace * t[:, None] + phase + k * np.pi / 2.0) for k in range(3))
    log = torchid.Log(
        "arm.npz", t, joint_names=arm.joint_names, joint_position=q, joint_velocity=v, joint_acceleration=a
    )
    phi = arm.nominal.copy()
    phi[1:, FRICTION] = level * np.array([1.0, 0.5])
    out = []
    for _ in range(count):
        exact = bind_log(replace(log, joint_torque=np.zeros_like(q)), arm, [])
        torque = torchid.Regressor(arm)(*exact.coordinates()) @ torch.from_numpy(phi.flatten())
        white = rng.normal(size=(len(t) + 2, arm.n))
        smeared = 0.3 * (white[2:] + white[1:-1] + white[:-2]) / np.sqrt(3.0)
        samples = replace(exact, torque=torque + torch.from_numpy(smeared), oversampling=3.0)
        problem = torchid.linear_problem(torchid.compress([samples], builder), builder, arm, friction=False)
        found = unfitted_friction(problem, arm)
        assert found is not None
        out.append(found)
    return out


def test_friction_that_is_not_fitted_shows_and_noise_does_not_look_like_it() -> None:
    none = noise_and_friction(0.0, 100)
    assert sum(one.significant for one in none) == 0
    assert 0.7 < np.mean([one.ratio for one in none]) < 1.3, "of noise it explains as much as of noise"
    for one in noise_and_friction(0.3, 10):
        assert one.significant
        assert one.combinations == 12
        assert one.units[0] == ("N m", "N m s/rad")
        assert np.allclose(one.values, [0.3, 0.15], atol=0.15)


@pytest.mark.filterwarnings(UNPHYSICAL)
def test_friction_that_the_model_lacks_is_said_before_all_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = {}
    for fitted in ("true", "false"):
        run = tmp_path / fitted
        command = [
            "identify",
            "--verbose",
            str(DEMO / "quadruped.yaml"),
            f"output={run}",
            f"estimator.friction={fitted}",
            f"actuators={ActuatorsConfig.without_terms()}".replace("None", "null"),
        ]
        assert main([*command, "estimator.ridge=0.001"]) == 0
        told[fitted] = json.loads((run / "metrics.json").read_text()), capsys.readouterr().out
    good, lacking = told["true"][0]["misfit"], told["false"][0]["misfit"]
    assert good["explained"]
    assert good["message"] == ""
    assert good["unfitted_friction"] is None
    assert told["true"][0]["residual_std"] == pytest.approx(good["expected_residual_std"], rel=0.05)
    assert 0.7 < good["lack_of_fit"] < 1.3
    assert "does not explain" not in told["true"][1]
    assert not lacking["explained"]
    assert "most in joint_torque" in lacking["message"]
    assert lacking["unfitted_friction"] > 100.0
    assert "friction, which is not fitted, explains" in lacking["message"]
    said = " ".join(told["false"][1].split())
    assert "attention Friction, compliance or contacts are missing" in said
    assert "unexplained residuals are 11 times" in said


def test_joints_that_rest_are_told_with_their_share_where_friction_goes_with_the_sign() -> None:
    arm, count = torchid.load_robot(UR5, fixed_base=True), 3000
    t, rng = np.arange(count) / 100.0, np.random.default_rng(0)
    velocity = np.cos(rng.uniform(3.0, 9.0, arm.n) * t[:, None])
    velocity[1000:2200, 1] = 1e-3 * rng.normal(size=1200)  # 40 % of the time
    velocity[:, 4] = 1e-3 * rng.normal(size=count)  # which nobody knows from noise
    directions = np.sign(velocity) * (np.arange(arm.n) != 4)
    log = torchid.Log(
        "arm.npz",
        t,
        joint_names=arm.joint_names,
        joint_position=velocity,
        joint_velocity=velocity,
        joint_acceleration=velocity,
        joint_torque=np.zeros_like(velocity),
        joint_direction=directions,
    )
    samples, names = bind_log(log, arm, []), arm.joint_names
    sensors = torchid.named_sensors("joints", arm.n, 0, torchid.SensorNoise(0.3, 1.0, 0.1))
    builder = torchid.RowBuilder(arm, [], sensors)
    free, fixed = (
        torchid.linear_problem(torchid.compress([samples], builder), builder, arm, friction=x) for x in (True, False)
    )
    found = resting_joints(free, arm, builder, [samples[:1200], samples[1200:]])
    assert list(found) == [names[4], names[1]]
    assert found[names[4]] == 1.0
    slow = 2.0 / np.pi * np.arcsin(0.1 * np.sqrt(0.3))  # of a sine, beside what rests 40 % of the time
    assert found[names[1]] == pytest.approx(0.4 + 0.6 * slow, abs=0.003)
    assert resting_joints(fixed, arm, builder, [samples]) == {}
    wide = torchid.RowBuilder(arm, [], sensors, ExtraTerms(sign_width=0.02))
    assert resting_joints(free, arm, wide, [samples]) == {}
