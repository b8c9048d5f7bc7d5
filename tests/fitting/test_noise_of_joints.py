"""The noise of an arm's joint torques, as residuals show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from synthetic import UR5, Array, Oracle, load, make_log, random_states
from true_robots import true_parameters

from torchid.config import load_config
from torchid.fitting.experiment import Experiment, set_up
from torchid.fitting.noise import NoiseSummary
from torchid.problem import Samples, bind_log
from torchid.regressor import Regressor

SAMPLES = 300


@dataclass(frozen=True)
class Arm:
    """A UR5 whose parameters and springs are known, what was recorded of it without noise, and rows of other motion."""

    experiment: Callable[..., Experiment]
    samples: Samples
    true: Array
    K: Array

    def noisy(self, std: Array, seed: int, count: int = SAMPLES) -> Samples:
        assert self.samples.torque is not None
        error = std * np.random.default_rng(seed).normal(size=(count, len(std)))
        few = self.samples[:count]
        return replace(few, torque=self.samples.torque[:count] + torch.from_numpy(error))


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Arm:
    robot, rng = load(UR5, fixed_base=True), np.random.default_rng(3)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    log = make_log(oracle, [], [[]], SAMPLES, rng)
    file = tmp_path_factory.mktemp("arm") / "arm.yaml"
    file.write_text(
        f"robot: {{urdf: {UR5}, fixed_base: true}}\nlogs: {{train: [{file}]}}\nsensors: joints\noutput: out\n"
    )
    q, v, a = (torch.from_numpy(x) for x in random_states(rng, robot.n, 100, fixed_base=True))
    K = Regressor(robot)(q, v, a).numpy()
    return Arm(
        lambda *overrides: set_up(load_config(file, overrides)),
        bind_log(log, robot, ()),
        true_parameters(oracle, robot).ravel(),
        K,
    )


def estimated(arm: Arm, samples: Samples, *overrides: str) -> NoiseSummary:
    experiment = arm.experiment(*overrides)
    return experiment.estimate_noise([samples], experiment.sensors)


@pytest.mark.parametrize("terms", ["actuators={torque_offset: true, stiffness: true}", "sensors.offsets=log"])
def test_parameters_of_sensors_and_actuators_do_not_hide_the_noise(arm: Arm, terms: str) -> None:
    """A fit that adapts them with the bodies' parameters leaves most of the noise to be seen."""
    found = estimated(arm, arm.noisy(np.full(6, 0.2), seed=1), terms)
    assert {one.origin for one in found.groups} <= {"estimated", "pooled"}
    np.testing.assert_allclose(found.noise.joint_torque, 0.2, rtol=0.1)
