"""Rejected samples are left out of a fit, with what the filter makes of them, and the fit is that of a clean log."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from faults import CONTACTS, CUTOFF, changed, demo_log, demo_robot
from motions import value

from torchid.cli import main
from torchid.errors import LogError, TorchidWarning
from torchid.estimators import Estimate, LeastSquares
from torchid.log_checks import NOTE, drop_rejected
from torchid.log_checks.check import check, excluded_stamps
from torchid.log_checks.spikes import warn_of_steps
from torchid.logs import Log, read_log, write_log
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, Samples, bind_log, compress, linear_problem
from torchid.sensing import SensorNoise, named_sensors

SPIKES = (200, 431, 700, 1011)


@cache
def spiked() -> Log:
    """The demo's log with a spike in a position or a torque every few seconds, and a hole in a torque."""
    log = changed(demo_log(), "joint_position", lambda q: q.__setitem__((SPIKES[0], 2), q[SPIKES[0], 2] + 0.3))
    log = changed(log, "joint_position", lambda q: q.__setitem__((SPIKES[1], 7), q[SPIKES[1], 7] - 0.5))
    log = changed(log, "joint_torque", lambda t: t.__setitem__((SPIKES[2], 4), 300.0))
    return changed(log, "joint_torque", lambda t: t.__setitem__((slice(SPIKES[3], SPIKES[3] + 5), 1), np.nan))


def processed(log: Log) -> Samples:
    return bind_log(preprocess(log, CUTOFF), demo_robot(), CONTACTS)


def fitted(samples: Samples) -> Estimate:
    noise = SensorNoise(joint_torque=0.1, contact_force=0.5, contact_moment=0.05)
    builder = RowBuilder(demo_robot(), CONTACTS, named_sensors("joints", 12, 4, noise))
    return LeastSquares(ridge=0.001).solve(linear_problem(compress([samples], builder), builder, demo_robot()))


def quietly_excluding(log: Log) -> Samples:
    checked = check(log, demo_robot(), CONTACTS, CUTOFF)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return drop_rejected(processed(checked.repaired), checked, CUTOFF, derived=True)


def test_without_rejected_samples_the_parameters_are_those_of_the_clean_log() -> None:
    kept = quietly_excluding(spiked())
    clean = processed(demo_log())
    same = np.isin(clean.time.numpy(), kept.time.numpy())
    truth, found = fitted(clean[np.flatnonzero(same)]), fitted(kept)
    hole = replace(spiked(), joint_torque=np.nan_to_num(value(spiked().joint_torque)))
    spoilt = fitted(processed(hole))
    error = np.abs(found.phi - truth.phi) / truth.standard_error
    harm = np.abs(spoilt.phi - truth.phi) / truth.standard_error
    seen = np.isfinite(truth.standard_error) & (truth.standard_error > 0.0)
    assert np.max(error[seen]) < 0.01, "a hundredth of a standard error is left of the spikes"
    assert np.max(harm[seen]) > 10.0, "which spoil the fit if they are not left out"
    assert found.residual_std == pytest.approx(truth.residual_std, rel=1e-4)
    whole = fitted(clean)
    assert np.max((np.abs(found.phi - whole.phi) / whole.standard_error)[seen]) < 1.0, "a tenth of the log is lost"


def test_holes_in_poses_are_found_and_left_out_where_that_is_asked_for(tmp_path: Path) -> None:
    holes = changed(demo_log(), "base_quat_xyzw", lambda quat: quat.__setitem__(slice(300, 310), np.nan))
    holes = changed(holes, "joint_position", lambda q: q.__setitem__((slice(700, 705), 3), np.nan))
    write_log(holes, tmp_path / "holes.npz")
    with pytest.raises(LogError, match="joint_position: nan at sample 700, front_right_hip; accepted: finite numbers"):
        read_log(tmp_path / "holes.npz")
    log = read_log(tmp_path / "holes.npz", allow_gaps=True)
    checked = check(log, demo_robot(), CONTACTS, CUTOFF)
    assert sorted(np.flatnonzero(checked.rejected)) == [*range(300, 310), *range(700, 705)]
    kept, clean = quietly_excluding(log), processed(demo_log())
    same = clean[np.flatnonzero(np.isin(clean.time.numpy(), kept.time.numpy()))]
    assert len(kept) == len(same) > 0.9 * len(clean)
    error = np.abs(fitted(kept).phi - fitted(same).phi) / fitted(same).standard_error
    assert np.nanmax(error) < 0.15, "of ten samples interpolated by a line; a residual twice as large hid half of it"


def test_what_was_interpolated_in_a_long_hole_is_not_compared_with_the_model() -> None:
    hole = slice(400, 600)
    log = changed(demo_log(), "joint_torque", lambda t: t.__setitem__((hole, slice(0, 6)), np.nan))
    checked = check(log, demo_robot(), CONTACTS, CUTOFF)
    assert [(x.name, x.field) for x in checked.findings if x.severity != NOTE] == [("not measured", "joint_torque")]
    np.testing.assert_array_equal(np.flatnonzero(checked.rejected), np.arange(hole.start, hole.stop))


def test_a_joint_that_is_recorded_late_is_not_called_frozen_too() -> None:
    log = changed(demo_log(), "joint_position", lambda q: q.__setitem__((slice(0, 150), 2), np.nan))
    findings = check(log, demo_robot(), CONTACTS, CUTOFF).findings
    assert [(x.name, x.field) for x in findings if x.severity != NOTE] == [("not measured", "joint_position")]


def test_a_pose_that_was_mostly_not_measured_makes_a_log_useless(tmp_path: Path) -> None:
    log = changed(demo_log(), "joint_position", lambda q: q.__setitem__((slice(0, 800), 3), np.nan))
    write_log(log, tmp_path / "gone.npz")
    checked = check(read_log(tmp_path / "gone.npz", allow_gaps=True), demo_robot(), CONTACTS, CUTOFF)
    assert checked.verdict == "not usable: joint_position: not measured"


@pytest.mark.parametrize("cutoff", [4.0, 8.0, 20.0])
def test_samples_are_left_out_over_the_reach_of_the_filter_and_two_more(cutoff: float) -> None:
    log = changed(demo_log(), "joint_torque", lambda t: t.__setitem__((650, 4), 300.0))
    checked = check(log)
    gone = demo_log().time[excluded_stamps(checked, demo_log().time, cutoff, derived=True)]
    margin = 1.0 / cutoff + 0.02
    assert abs(gone[0] - (6.5 - margin)) < 0.0101
    assert abs(gone[-1] - (6.5 + margin)) < 0.0101


def test_a_log_that_is_not_processed_loses_its_rejected_samples_alone() -> None:
    log = changed(preprocess(demo_log()), "joint_torque", lambda t: t.__setitem__((slice(650, 653), 4), 300.0))
    checked = check(log)
    assert np.flatnonzero(excluded_stamps(checked, log.time, None, derived=False)).tolist() == [650, 651, 652]
    assert np.flatnonzero(excluded_stamps(checked, log.time, None, derived=True)).tolist() == list(range(648, 655))


def test_a_clean_log_is_returned_as_it_is_without_a_word() -> None:
    samples, checked = processed(demo_log()), check(demo_log(), demo_robot(), CONTACTS, CUTOFF)
    assert drop_rejected(samples, checked, CUTOFF, derived=True) is samples


def test_what_is_left_out_is_told_with_the_reasons() -> None:
    checked = check(spiked(), demo_robot(), CONTACTS, CUTOFF)
    with pytest.warns(
        TorchidWarning, match=r"sway_train.npz: \d+ of 1250 samples excluded: .*spike at samples 200, 431"
    ):
        drop_rejected(processed(checked.repaired), checked, CUTOFF, derived=True)


def test_a_log_that_is_not_usable_is_refused_in_one_line() -> None:
    log = replace(demo_log(), joint_position=np.degrees(demo_log().joint_position))
    with pytest.raises(LogError, match=r"not usable: joint_position: unit; accepted: .*exclude_rejected: false"):
        drop_rejected(processed(demo_log()), check(log), CUTOFF, derived=True)


@pytest.mark.parametrize(
    ("by", "until", "told"),
    [
        (
            0.05,
            None,
            r"sway_train.npz: joint_position, step: front_left_knee jumps by 0.0\d+ rad at sample 249-250, .*; split",
        ),
        (2.0 * np.pi, None, r"joint_position, wrapped angle: front_left_knee jumps by 6.\d+ rad at sample 249-250, "),
        (0.05, 253, None),
        (0.002, None, None),
    ],
    ids=["another zero", "a whole turn", "three samples", "less than an error of its calibration"],
)
def test_an_encoder_that_steps_is_named_without_a_check(
    by: float, until: int | None, told: str | None, recwarn: pytest.WarningsRecorder
) -> None:
    joint, part = demo_log().joint_names.index("front_left_knee"), slice(250, until)
    log = changed(demo_log(), "joint_position", lambda q: q.__setitem__((part, joint), q[part, joint] + by))
    warn_of_steps(log)
    said = [str(one.message) for one in recwarn]
    assert len(said) == (0 if told is None else 1)
    assert told is None or re.search(told, said[0])


def test_identify_says_that_an_encoder_steps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shortened_demo(tmp_path / "demo", 400)
    log = read_log(folder / "sway_train.npz")
    stepped = changed(log, "joint_position", lambda q: q.__setitem__((slice(150, None), 2), q[150:, 2] + 0.05))
    write_log(stepped, folder / "sway_train.npz")
    assert main(["identify", str(folder / "quadruped.yaml"), f"output={tmp_path / 'run'}"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "joint_position, step" in line]
    assert len(told) == 1
    assert f"sway_train.npz: joint_position, step: {log.joint_names[2]} jumps by 0.0" in told[0]


def test_identify_and_evaluate_count_what_they_leave_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shortened_demo(tmp_path / "demo", 500)
    log = read_log(folder / "sway_train.npz")
    torque = value(log.joint_torque).copy()
    torque[250, 3] += 200.0
    write_log(replace(log, joint_torque=torque), folder / "sway_train.npz")
    run, key = tmp_path / "run", "preprocessing.exclude_rejected=true"
    assert main(["identify", str(folder / "quadruped.yaml"), f"output={run}", key]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "excluded" in line]
    assert len(told) == 1
    assert "samples excluded: joint_torque spike at samples 250" in told[0]
    counts = json.loads((run / "metrics.json").read_text())["excluded_samples"]
    assert counts == {str(folder / "sway_train.npz"): 29, str(folder / "sway_test.npz"): 0}
    assert main(["evaluate", str(run), "--log", str(folder / "sway_train.npz")]) == 0
    assert json.loads((run / "evaluation/sway_train/metrics.json").read_text())["sway_train"]["excluded_samples"] == 29
