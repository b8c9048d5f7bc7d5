"""Samples near changes of contact can be left out: impacts and slip are no rigid-body dynamics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from demo import shortened_demo
from refusals import refusal
from repository import DEMO
from rich.progress import Progress
from synthetic import SOLO12, Array, Oracle, load, make_log
from true_robots import true_parameters

from torchid.commands.chosen_settings import with_chosen_settings
from torchid.config import load_config
from torchid.estimators import LeastSquares
from torchid.fitting.experiment import set_up
from torchid.logs import read_log, write_log
from torchid.logs.preprocess import near_contact_changes
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.reading.log_reader import LogReader

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
PHASE, STEP, SLIP = 40, 0.01, 0.05  # samples of a phase, s, s
STATES = [[True] * 4, [False, True, True, True], [True] * 4, [True, False, True, True]]


def slipping(folder: Path, slip: float, gains: float = 0.0) -> tuple[Path, Array]:
    """An experiment file whose log has a wrong torque of 20 N m within `slip` [s] of each change; true parameters.

    `gains`: standard deviation of the gains of the torque sensors.
    """
    robot, rng = load(SOLO12), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    states = [state for state in STATES for _ in range(PHASE)]
    log = make_log(oracle, [(foot, 3) for foot in FEET], states, 2 * len(states), rng)
    assert log.joint_torque is not None
    edges = STEP * (np.arange(PHASE, len(log), PHASE) - 0.5)
    near = (np.abs(log.time[:, None] - edges) <= slip).any(axis=1)
    log.joint_torque[near] += 20.0
    log.joint_torque[:] *= 1.0 + gains * rng.normal(size=robot.n)
    write_log(log, folder / "steps.h5")
    contacts = [{"frame": foot, "type": "point", "radius": 0} for foot in FEET]
    settings = {
        "robot": {"urdf": str(SOLO12)},
        "contacts": contacts,
        "sensors": "joints",
        "output": str(folder / "run"),
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings | {"logs": {"train": ["steps.h5"]}}))
    return folder / "experiment.yaml", true_parameters(oracle, robot).ravel()


def read(file: Path, *overrides: str) -> tuple[Samples, RowBuilder]:
    experiment = set_up(load_config(file, overrides))
    builder = RowBuilder(experiment.robot, experiment.contacts, experiment.sensors)
    return LogReader(experiment).read(experiment.config.logs.train, experiment.sensors)[0], builder


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize(("margin", "exact"), [(None, False), (0.5 * SLIP, False), (SLIP, True)])
def test_slip_around_changes_of_contact_spoils_a_fit_unless_a_margin_covers_it(
    tmp_path: Path, margin: float | None, exact: bool
) -> None:
    file, true = slipping(tmp_path, SLIP)
    samples, builder = read(file, f"preprocessing.contact_margin_s={'null' if margin is None else margin}")
    robot = load(SOLO12)
    estimate = LeastSquares().solve(linear_problem(compress([samples], builder), builder, robot))
    known = estimate.verdict == "identified"
    error = np.abs(estimate.phi - true)[known].max()
    assert known.sum() > 60
    assert error < 1e-7 if exact else error > 0.1


@pytest.mark.parametrize("scales", ["{}", "{joint_torque: all}", "{joint_torque: log}"])
def test_the_same_margin_is_chosen_whether_gains_are_fitted_or_not(tmp_path: Path, scales: str) -> None:
    """With a free common gain all forces would shrink, and with them the errors at changes of contact."""
    file, _ = slipping(tmp_path, SLIP, gains=0.1)
    terms = "armature: false, torque_offset: false, delay: null, stiffness: false, asymmetric_coulomb: false"
    settings = [f"actuators={{{terms}, stiction: false, sign_width: null}}", "preprocessing.contact_margin_s=auto"]
    experiment = set_up(load_config(file, [*settings, f"sensors={{set: joints, scales: {scales}}}"]))
    _, choices = with_chosen_settings(experiment, Progress(disable=True))
    assert choices.contact_margin is not None
    assert choices.contact_margin.value == 0.06, "the first that covers the slip"


def test_a_margin_leaves_whole_phases_but_for_their_ends(tmp_path: Path) -> None:
    file, _ = slipping(tmp_path, SLIP)
    samples, _ = read(file, "preprocessing.contact_margin_s=0.1")
    into_phase = np.arange(320) % PHASE
    after, before = into_phase, PHASE - 1 - into_phase  # samples since the first, until the last of its phase
    near = ((after <= 10) & (np.arange(320) >= PHASE)) | ((before <= 10) & (np.arange(320) < 320 - PHASE))
    np.testing.assert_array_equal(samples.time.numpy(), STEP * np.flatnonzero(~near))
    assert samples.source == str(file.parent / "steps.h5")


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_margin_longer_than_the_phases_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, _ = slipping(tmp_path, SLIP)
    samples, _ = read(file, "preprocessing.contact_margin_s=0.25")
    assert len(samples) == 2 * (PHASE - 26), "the outer ends of the first and last phase, that no change is near to"
    line = refusal(["identify", str(file), "preprocessing.contact_margin_s=30"], tmp_path, capsys)
    assert "contact_active: all samples are within 30 s of a change of contact" in line
    assert "preprocessing.contact_margin_s" in line


def test_margins_in_a_filtered_log_count_from_the_change_that_was_recorded(tmp_path: Path) -> None:
    folder, margin = shortened_demo(tmp_path / "demo", 600), 0.15
    recorded = read_log(folder / "sway_train.npz")
    assert recorded.contact_active is not None
    settings = ("preprocessing.cutoff_hz=8", "preprocessing.sample_rate_hz=170")
    every, _ = read(folder / "quadruped.yaml", *settings)
    samples, _ = read(folder / "quadruped.yaml", *settings, f"preprocessing.contact_margin_s={margin}")
    changes = np.flatnonzero((np.diff(recorded.contact_active.astype(int), axis=0) != 0).any(axis=1))
    before, after = recorded.time[changes], recorded.time[changes + 1]
    time = every.time.numpy()[:, None]
    near = ((time >= before - margin) & (time <= after + margin)).any(axis=1)
    assert 0 < near.sum() < len(near)
    np.testing.assert_array_equal(samples.time.numpy(), every.time.numpy()[~near])
    assert samples.active.numpy().sum() > 0


def test_a_margin_of_nothing_drops_the_two_samples_of_a_change_and_a_log_without_contacts_keeps_all() -> None:
    log = read_log(DEMO / "sway_train.npz")
    assert log.contact_active is not None
    changed = (log.contact_active[1:] != log.contact_active[:-1]).any(axis=1)
    expected = np.append(changed, False) | np.append(False, changed)
    np.testing.assert_array_equal(near_contact_changes(log, log.time, 0.0), expected)
    still = log.select(slice(0, 2))
    assert not near_contact_changes(still, still.time, 5.0).any()


@pytest.mark.parametrize("value", ["-0.1", ".inf", "'0.1 s'", "true"])
def test_margins_that_are_no_time_are_refused(tmp_path: Path, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shortened_demo(tmp_path / "demo", 300)
    arguments = ["identify", str(folder / "quadruped.yaml"), f"preprocessing.contact_margin_s={value}"]
    assert "preprocessing.contact_margin_s" in refusal(arguments, folder, capsys)
