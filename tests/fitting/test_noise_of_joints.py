"""Each joint's torque has noise of its own: stated by name, or as residuals show it, and pooled where they do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from intervals import covered
from synthetic import UR5, Array, Oracle, load, make_log, random_states
from true_robots import true_parameters

from torchid.config import load_config
from torchid.errors import InputError
from torchid.estimators import Estimate, LeastSquares
from torchid.fitting.experiment import Experiment, set_up
from torchid.fitting.fit import LogFitter
from torchid.fitting.noise import NoiseSummary
from torchid.problem import RowBuilder, Samples, bind_log, compress_parts
from torchid.problem.noise import prior_precision
from torchid.regressor import Regressor
from torchid.sensing import SensorNoise

SAMPLES, FEW = 300, 15
REPEATS = 8
UNLIKE = np.geomspace(1.0, 1e-3, 6)


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

    def fit(self, samples: Samples, noise: SensorNoise) -> Estimate:
        experiment = self.experiment()
        builder = RowBuilder(experiment.robot, (), replace(experiment.sensors, noise=noise))
        fitter = LogFitter(robot=experiment.robot, builder=builder, estimator=LeastSquares())
        return fitter.fit(compress_parts([samples], builder, threads=1)).estimate

    def errors(self, fits: list[Estimate]) -> Array:
        """Rms errors of predicted torques by joint, (n,)."""
        off = np.array([self.K @ (fit.phi - self.true) for fit in fits])
        return np.asarray(np.sqrt(np.square(off).mean(axis=(0, 1))))


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


def test_patterns_name_the_joints_whose_torques_are_measured(arm: Arm) -> None:
    sensors = arm.experiment("sensors.set=null", "sensors.joint_torques=['wrist_?_joint', elbow_joint]").sensors
    names = arm.experiment().robot.joint_names
    assert [name for name, measured in zip(names, sensors.torque, strict=True) if measured] == [*names[2:]]
    with pytest.raises(InputError, match=r"sensors\.joint_torques: '\*_knee' matches no joint that moves"):
        arm.experiment("sensors.set=null", "sensors.joint_torques=['*_knee']")


def estimated(arm: Arm, samples: Samples, *overrides: str) -> NoiseSummary:
    experiment = arm.experiment(*overrides)
    return experiment.estimate_noise([samples], experiment.sensors)


@pytest.mark.parametrize("terms", ["actuators={torque_offset: true, stiffness: true}", "sensors.offsets=log"])
def test_parameters_of_sensors_and_actuators_do_not_hide_the_noise(arm: Arm, terms: str) -> None:
    """A fit that adapts them with the bodies' parameters leaves most of the noise to be seen."""
    found = estimated(arm, arm.noisy(np.full(6, 0.2), seed=1), terms)
    assert {one.origin for one in found.groups} <= {"estimated", "pooled"}
    np.testing.assert_allclose(found.noise.joint_torque, 0.2, rtol=0.1)


# ---------------------------------------------------------------------------------------------------------- estimated


def test_noise_of_joints_a_thousand_times_apart_is_told_apart(arm: Arm) -> None:
    """Joints of little noise are predicted far better than with one figure for all, and intervals hold the truth."""
    std = 3.0 * UNLIKE
    logs = [arm.noisy(std, seed) for seed in range(REPEATS)]
    found = [estimated(arm, log) for log in logs]
    fits = [arm.fit(log, one.noise) for log, one in zip(logs, found, strict=True)]
    alike = [arm.fit(log, SensorNoise()) for log in logs]
    assert (arm.errors(fits)[3:] < 0.2 * arm.errors(alike)[3:]).all()
    assert (arm.errors(fits) < 1.02 * arm.errors(alike)).all()
    assert 0.92 < covered(fits, arm.true).mean() < 0.98
    np.testing.assert_allclose(np.median([one.noise.joint_torque for one in found], axis=0), std, rtol=0.1)


def test_the_spread_of_alike_variances_is_the_most_likely_one() -> None:
    """Against the likelihood of estimates that are normal about them, by its determinant, over a grid."""
    rng, count = np.random.default_rng(0), 8
    for true in (0.0, 0.5, 4.0):
        root = rng.normal(size=(count, count))
        information = root @ root.T + np.diag(rng.uniform(1.0, 40.0, count))
        C = np.linalg.inv(information)
        estimate = 2.0 + np.sqrt(true) * rng.normal(size=count) + np.linalg.cholesky(C) @ rng.normal(size=count)
        present = rng.normal(size=count)
        precision = prior_precision(present, information, information @ (estimate - present))
        variance = (1.0 - 1.0 / count) / precision[0, 0]

        def deviance(variance: float, C: Array = C, estimate: Array = estimate) -> float:
            inverse = np.linalg.inv(C + variance * np.eye(count))
            weight = inverse.sum()
            off = estimate - inverse.sum(0) @ estimate / weight
            return float(-np.linalg.slogdet(inverse)[1] + np.log(weight) + off @ inverse @ off)

        grid = np.geomspace(1e-4, 1e3, 4001)
        assert deviance(variance) < min(deviance(x) for x in grid) + 1e-6
        np.testing.assert_allclose(precision.sum(0), 0.0, atol=1e-9 * precision[0, 0])


# ------------------------------------------------------------------------------------------------------------- stated


def test_stated_noise_is_that_of_the_pattern_with_most_letters(arm: Arm) -> None:
    experiment = arm.experiment("sensors.noise.joint_torque={'*': 0.5, 'wrist_*': 0.02, wrist_3_joint: 0.01}")
    assert experiment.noise.joint_torque == experiment.sensors.noise.joint_torque == (0.5, 0.5, 0.5, 0.02, 0.02, 0.01)
    found = estimated(arm, arm.samples, "sensors.noise.joint_torque={'*': 0.5, 'wrist_*': 0.02, wrist_3_joint: 0.01}")
    assert [(one.used, one.origin) for one in found.groups] == [
        (x, "stated") for x in (0.5, 0.5, 0.5, 0.02, 0.02, 0.01)
    ]
    assert found.noise.joint_torque == experiment.noise.joint_torque


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ("{'*': 0.5, wrist_4_joint: 0.1}", "sensors.noise.joint_torque: unknown name 'wrist_4_joint'; accepted: "),
        ("{'wrist_*': 0.1}", "sensors.noise.joint_torque: no noise for shoulder_pan_joint; accepted: one for every"),
        ("{'wrist_?_joint': 0.1, 'wrist_*_joint': 0.2, '*': 1}", "sensors.noise.joint_torque: two values for wrist_1"),
        ("{'*': 0}", "sensors.noise.joint_torque: found {'*': 0}; accepted: a number greater than 0, or one by name"),
        ("{'*': 0.1, wrist_1_joint: -1}", "sensors.noise.joint_torque: found {'*': 0.1, 'wrist_1_joint': -1}; acc"),
        ("[0.1, 0.2]", "sensors.noise.joint_torque: found [0.1, 0.2]; accepted: a number greater than 0, or one by"),
        ("0", "sensors.noise.joint_torque: found 0; accepted: a number greater than 0, or one by name or pattern"),
    ],
)
def test_noise_of_joints_that_does_not_fit_the_robot_is_refused_in_one_line(
    arm: Arm, stated: str, message: str
) -> None:
    with pytest.raises(InputError) as error:
        arm.experiment(f"sensors.noise.joint_torque={stated}")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_stated_noise_that_is_wrong_of_one_joint_is_named(arm: Arm) -> None:
    std = np.array([0.3, 0.3, 0.3, 0.3, 0.3, 0.01])
    found = estimated(arm, arm.noisy(std, seed=0), "sensors.noise.joint_torque=0.3")
    assert found.noise.joint_torque == (0.3,) * 6
    *others, last = found.suggested["joint_torque"].values()
    assert others == pytest.approx([0.3] * 5, rel=0.2)
    assert 0.01 < last < 0.1, "with the errors of parameters that the other joints' noise makes"
    assert not estimated(arm, arm.noisy(np.full(6, 0.3), seed=0), "sensors.noise.joint_torque=0.3").suggested


def test_a_number_for_each_joint_but_one_is_refused(arm: Arm) -> None:
    with pytest.raises(InputError, match="joint_torque: 5 numbers; accepted: 1 number for all joints, or 6"):
        arm.fit(arm.samples, SensorNoise(joint_torque=(0.1,) * 5))
