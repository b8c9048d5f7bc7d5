"""Residuals show the noise of sensors and base rows, by axis of the levelled base; then intervals hold the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from intervals import covered
from scipy import stats
from scipy.spatial.transform import Rotation
from synthetic import SOLO12, Array, Oracle, load, make_log
from thinned import study_but
from true_robots import true_parameters

from torchid.config import load_config
from torchid.estimators import Estimate, LeastSquares
from torchid.fitting.experiment import Experiment, set_up, with_noise
from torchid.fitting.fit import LogFitter
from torchid.fitting.noise import NoiseSummary, recorded_sensors
from torchid.parameters import MASS, PER_BODY
from torchid.problem import RowBuilder, Samples, bind_log, compress_parts
from torchid.problem.extras import NoiseGroups
from torchid.problem.motion import levelled_base_axes
from torchid.sensing import SensorNoise
from torchid.sensing.projection import whitened_null_space

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
STATES = [[True] * 4, [False, True, True, True], [True, True, False, True]]
SAMPLES = 300
HORIZONTAL, VERTICAL = 2.3, 0.1  # N: of differentiated odometry, 0.9 and 0.04 m/s^2 of a robot of 2.5 kg
TRUE = SensorNoise(0.1, 0.2, 0.02, (HORIZONTAL, HORIZONTAL, VERTICAL), (0.1, 0.2, 0.05))
QUICK, MANY = 8, 200


# ------------------------------------------------------------------------------------------------------- axes and rows


def test_the_levelled_base_has_the_vertical_for_an_axis_and_is_the_base_where_that_stands_upright() -> None:
    rng = np.random.default_rng(0)
    turned = Rotation.from_euler("z", rng.uniform(-3.0, 3.0, (20, 1))).as_matrix()
    np.testing.assert_allclose(
        levelled_base_axes(torch.from_numpy(turned)), np.tile(np.eye(3), (20, 1, 1)), rtol=0.0, atol=1e-15
    )
    R = Rotation.random(200, random_state=1).as_matrix()
    axes = levelled_base_axes(torch.from_numpy(R)).numpy()
    np.testing.assert_allclose(axes.transpose(0, 2, 1) @ axes, np.tile(np.eye(3), (200, 1, 1)), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    up = np.abs(R[:, 2]).argmax(1)
    in_world = R @ axes
    vertical = np.take_along_axis(in_world, up[:, None, None].repeat(3, 1), 2)[..., 0]
    np.testing.assert_allclose(np.abs(vertical), np.tile([0.0, 0.0, 1.0], (200, 1)), rtol=0.0, atol=1e-14)
    angle = np.degrees(Rotation.from_matrix(axes).magnitude())
    np.testing.assert_allclose(angle, np.degrees(np.arccos(np.abs(R[:, 2]).max(1))), rtol=0.0, atol=1e-6)
    assert angle.max() < 54.74


def test_rows_are_white_under_noise_along_the_axes_of_the_levelled_base() -> None:
    rng = np.random.default_rng(2)
    A, J = (torch.from_numpy(rng.normal(size=(5, k, 10))) for k in (3, 4))
    row_std, wrench_std = (torch.from_numpy(rng.uniform(0.1, 3.0, k)) for k in (10, 4))
    axes = torch.from_numpy(Rotation.random(5, random_state=3).as_matrix())
    ((index, W),) = whitened_null_space(A, row_std, J, wrench_std, axes)
    assert index == slice(None)
    T = torch.eye(10, dtype=torch.float64).repeat(5, 1, 1)
    T[:, :3, :3] = T[:, 3:6, 3:6] = axes
    S = T @ torch.diag(row_std**2) @ T.mT + J.mT @ torch.diag(wrench_std**2) @ J
    np.testing.assert_allclose(W.mT @ S @ W, torch.eye(7, dtype=torch.float64).repeat(5, 1, 1), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(A @ W, 0.0, atol=1e-12)


# ---------------------------------------------------------------------------------------------------- repeated walking


@dataclass(frozen=True)
class RobotSetup:
    """A quadruped that is upright on three or four feet, without noise, and what is true."""

    experiment: Callable[..., Experiment]
    samples: Samples
    true: Array


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> RobotSetup:
    robot, rng = load(SOLO12), np.random.default_rng(1)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    log = make_log(oracle, [(foot, 3) for foot in FEET], STATES, SAMPLES, rng, tilt=0.1)
    file = tmp_path_factory.mktemp("noise") / "experiment.yaml"
    contacts = ", ".join(f"{{frame: {foot}, type: point, radius: 0}}" for foot in FEET)
    file.write_text(
        f"robot: {{urdf: {SOLO12}}}\ncontacts: [{contacts}]\nlogs: {{train: [{file}]}}\nsensors: full\noutput: out\n"
    )

    def experiment(*overrides: str) -> Experiment:
        return set_up(load_config(file, overrides))

    contacts_in_use = experiment().contacts
    return RobotSetup(experiment, bind_log(log, robot, contacts_in_use), true_parameters(oracle, robot).ravel())


@dataclass(frozen=True)
class Fits:
    """Of repeated experiments."""

    found: list[NoiseSummary]
    guessed: list[Estimate]
    estimated: list[Estimate]


def read(setup: RobotSetup, rng: np.random.Generator, push: Array) -> Samples:
    """With noise of sensors, and forces on the base (N, 6) that nothing measures: what the feet then seem to bear."""
    samples, experiment = setup.samples, setup.experiment()
    builder = RowBuilder(experiment.robot, experiment.contacts, experiment.sensors)
    J = builder.contact_jacobian(samples)[:, :, :3].flatten(1, 2).numpy()
    J = J * np.repeat(samples.active.numpy(), 3, axis=1)[..., None]
    borne = np.linalg.pinv(J[:, :, :6].transpose(0, 2, 1), rcond=1e-9) @ push[..., None]
    held = -J[:, :, 6:].transpose(0, 2, 1) @ borne
    wrench, torque = samples.wrench.clone(), samples.torque.clone()
    wrench[:, :, :3] += torch.from_numpy(
        borne.reshape(-1, 4, 3) + TRUE.contact_force * rng.normal(size=(SAMPLES, 4, 3))
    )
    torque += torch.from_numpy(held[..., 0] + TRUE.joint_torque * rng.normal(size=torque.shape))
    return replace(samples, wrench=wrench, torque=torque)


def axes_of(setup: RobotSetup) -> Array:
    return levelled_base_axes(setup.samples.base.rotation).numpy()


def pushed(setup: RobotSetup, rng: np.random.Generator) -> Samples:
    push = (TRUE.base_std * rng.normal(size=(SAMPLES, 6))).reshape(-1, 2, 3)
    return read(setup, rng, np.einsum("nij,nkj->nki", axes_of(setup), push).reshape(-1, 6))


def fit(experiment: Experiment, samples: Samples, noise: SensorNoise | None = None) -> Estimate:
    sensors = experiment.sensors if noise is None else replace(experiment.sensors, noise=noise)
    builder = RowBuilder(experiment.robot, experiment.contacts, sensors)
    fitter = LogFitter(robot=experiment.robot, builder=builder, estimator=LeastSquares())
    return fitter.fit(compress_parts([samples], builder, threads=1)).estimate


def origins(found: NoiseSummary) -> dict[str, str]:
    return {one.group: one.origin for one in found.groups}


def fits(
    setup: RobotSetup, sensors: str, noisy: Callable[[RobotSetup, np.random.Generator], Samples], repeats: int
) -> Fits:
    """Of repeated experiments, with the guess and with the noise that each of them shows."""
    experiment = setup.experiment(f"sensors={sensors}", "sensors.on_base_lost=warn")
    out = Fits([], [], [])
    for seed in range(repeats):
        samples = noisy(setup, np.random.default_rng(seed))
        found = experiment.estimate_noise([samples], experiment.sensors)
        out.found.append(found)
        out.guessed.append(fit(experiment, samples, SensorNoise()))
        out.estimated.append(fit(experiment, samples, found.noise))
    return out


def mass_errors(estimates: list[Estimate], true: Array) -> Array:
    """Of the total mass, relative."""
    masses = np.array([estimate.phi.reshape(-1, PER_BODY)[:, MASS].sum() for estimate in estimates])
    return masses / true.reshape(-1, PER_BODY)[:, MASS].sum() - 1.0


def check_intervals(setup: RobotSetup, sensors: str, repeats: int) -> None:
    found = fits(setup, sensors, pushed, repeats)
    after, before = (covered(x, setup.true).mean(axis=0) for x in (found.estimated, found.guessed))
    assert len(after) > 50
    allowed = stats.binom.ppf([1e-5, 1.0 - 1e-5], repeats, 0.95) / repeats
    assert 0.92 < after.mean() < 0.98
    assert after.min() >= allowed[0] - 0.02, "noise that is estimated adds a little to the errors"
    assert before.mean() < after.mean() - 0.03, "with the guess, errors of all rows count alike"
    if sensors != "joints":
        before, after = (np.sqrt(np.mean(mass_errors(x, setup.true) ** 2)) for x in (found.guessed, found.estimated))
        assert after < 0.5 * before
    for group, true in NoiseGroups.of(setup.experiment().robot).values(TRUE).items():
        here = [(x.used, x.origin) for found_once in found.found for x in found_once.groups if x.group == group]
        if here and group != "contact_moment" and [origin for _, origin in here].count("estimated") == repeats:
            assert np.median([used for used, _ in here]) == pytest.approx(true, rel=0.1), group
    told = origins(found.found[0])
    assert told["base_force.x"] == told["base_force.y"] == told["base_moment.x"] == "estimated"


@pytest.mark.parametrize("sensors", study_but(["full"], ["full", "contacts", "joints"]))
def test_intervals_hold_the_truth_with_the_noise_that_residuals_show(setup: RobotSetup, sensors: str) -> None:
    check_intervals(setup, sensors, QUICK)


# ---------------------------------------------------------------------------------------------- what is stated is kept


def test_noise_that_is_all_stated_is_used_to_the_last_bit(setup: RobotSetup) -> None:
    stated = (
        "sensors.noise={joint_torque: 0.1, contact_force: 0.2, contact_moment: 0.02, base_force: 1, base_moment: 0.2}"
    )
    experiment = setup.experiment(stated)
    samples = pushed(setup, np.random.default_rng(0))
    found = experiment.estimate_noise([samples], experiment.sensors)
    used = with_noise(experiment, found)
    assert set(origins(found).values()) == {"stated"}
    assert found.passes == 1
    unfitted = experiment.estimate_noise([samples], experiment.sensors, suggest=False)
    assert (unfitted.noise, origins(unfitted), unfitted.passes) == (found.noise, origins(found), 0)
    assert used.config == experiment.config
    before, after = fit(experiment, samples), fit(used, samples)
    assert (before.phi == after.phi).all()
    assert np.array_equal(before.standard_error, after.standard_error, equal_nan=True)


def test_stated_noise_that_residuals_contradict_is_kept_and_the_estimate_suggested(setup: RobotSetup) -> None:
    stated = "sensors.noise={joint_torque: 0.1, contact_force: 0.2, base_force: 0.2, base_moment: 0.15}"
    experiment = setup.experiment(stated)
    found = experiment.estimate_noise([pushed(setup, np.random.default_rng(0))], experiment.sensors)
    assert found.noise.base_force == (0.2,) * 3
    assert found.suggested["joint_torque"] == pytest.approx(dict.fromkeys(experiment.robot.joint_names, 0.1), rel=0.1)
    assert found.suggested["contact_force"] == pytest.approx(0.2, rel=0.2)
    unasked = experiment.estimate_noise([pushed(setup, np.random.default_rng(0))], experiment.sensors, suggest=False)
    assert (unasked.noise, unasked.suggested) == (found.noise, {})
    right = setup.experiment("sensors.noise={joint_torque: 0.1, contact_force: 0.2}")
    assert not right.estimate_noise([pushed(setup, np.random.default_rng(0))], right.sensors).suggested


def test_what_is_estimated_keeps_the_proportion_to_what_is_stated(setup: RobotSetup) -> None:
    """As where a filter has left a tenth of a sensor's noise: weights and intervals are those of the right noise."""
    samples = pushed(setup, np.random.default_rng(0))
    alone, beside = setup.experiment(), setup.experiment("sensors.noise={joint_torque: 1.0}")
    estimated, proportional = (x.estimate_noise([samples], x.sensors).noise for x in (alone, beside))
    assert proportional.joint_torque == (1.0,) * 12
    ratio = 1.0 / np.mean(estimated.joint_torque)
    np.testing.assert_allclose(proportional.base_std[:2], ratio * estimated.base_std[:2], rtol=0.05)
    one, other = fit(alone, samples, estimated), fit(beside, samples, proportional)
    known = one.identifiable
    np.testing.assert_allclose(one.standard_error[known], other.standard_error[known], rtol=0.1)


# -------------------------------------------------------------------------------------------------------------- limits


def test_impacts_do_not_pass_for_noise(setup: RobotSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = pushed(setup, np.random.default_rng(0))
    hit = samples.base.specific_force.clone()
    hit[::25] += 20.0
    experiment = setup.experiment()

    def estimated(specific_force: torch.Tensor) -> SensorNoise:
        moved = replace(samples, base=replace(samples.base, specific_force=specific_force))
        return experiment.estimate_noise([moved], experiment.sensors).noise

    clean, spoilt = estimated(samples.base.specific_force), estimated(hit)
    monkeypatch.setattr("torchid.problem.noise.CLIP", 1e9)
    unclipped = estimated(hit)
    assert unclipped.base_std[0] > 3.0 * clean.base_std[0]
    assert spoilt.base_std[0] < 1.6 * clean.base_std[0]
    assert np.max(np.divide(spoilt.joint_torque, clean.joint_torque)) < 1.2


def test_exact_logs_and_logs_of_a_few_samples_leave_noise_that_is_positive(setup: RobotSetup) -> None:
    experiment = setup.experiment()
    exact = experiment.estimate_noise([setup.samples], experiment.sensors)
    few = experiment.estimate_noise([setup.samples[:3]], experiment.sensors)
    assert min(one.used for groups in (exact.groups, few.groups) for one in groups) > 0.0
    assert exact.noise.joint_torque == pytest.approx((1e-3 * SensorNoise().joint_torque,) * 12), "the floor"
    assert "assumed" in origins(few).values()


def test_the_sensors_of_a_log_are_those_whose_every_value_it_has(setup: RobotSetup) -> None:
    samples, experiment = setup.samples, setup.experiment()
    wrench, torque = samples.wrench.clone(), samples.torque.clone()
    wrench[~samples.active] = torch.nan
    torque[5, 2] = wrench[0, 0, 1] = torch.nan
    found = recorded_sensors(
        experiment.robot, experiment.contacts, [samples, replace(samples, wrench=wrench, torque=torque)]
    )
    assert np.flatnonzero(~found.torque).tolist() == [2]
    assert np.argwhere(~found.wrench[:, :3]).tolist() == [[0, 1]]
    assert not recorded_sensors(
        experiment.robot, experiment.contacts, [replace(samples, wrench=None, torque=None)]
    ).wrench.any()
