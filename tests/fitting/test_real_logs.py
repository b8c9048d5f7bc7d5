"""Recorded logs: an arm with offsets of torques, a person on plates with some, a quadruped with PD laws and delays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loadable import assert_loads
from repository import CONFIGS, SHARED
from synthetic import ROBOTS

from torchid.cli import main
from torchid.errors import ConfoundedWarning
from torchid.identifiability.confounding import INFLATION_LIMIT

pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason="the recorded logs (../shared/data) are not here")


def identified(output: Path, config: str, *overrides: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `torchid identify` writes: metrics and parameters."""
    assert main(["identify", str(CONFIGS / config), f"output={output}", *overrides]) == 0
    metrics, parameters = (json.loads((output / f"{name}.json").read_text()) for name in ("metrics", "parameters"))
    return metrics, parameters


def test_an_arm_that_can_exist_is_predicted_to_two_percent_on_a_run_that_no_fit_has_seen(tmp_path: Path) -> None:
    metrics, parameters = identified(tmp_path / "kuka", "kuka_lwr4.yaml")
    assert metrics["test"]["nullspace_rms_relative"] <= 0.0214  # rms over all joints; 0.0210 measured
    assert metrics["test"]["base_force_rms"] is None
    assert metrics["violations"] == []
    assert_loads(tmp_path / "kuka" / "identified.urdf", sum(one["identified"]["m"] for one in parameters["bodies"]))
    x, y = np.rad2deg(metrics["base_tilt_selection"]["value"])
    assert -2.5 < x < -1.3, "the table is not level, whatever else is fitted"
    assert abs(y) < 0.8
    offsets = {x["name"]: x for x in parameters["extras"] if x["what"] == "offset"}
    assert len(offsets) == 7
    assert all(x["log"] is None and x["unit"] == "N m" for x in offsets.values())
    springs = {x["name"]: x for x in parameters["extras"] if x["what"] == "stiffness"}
    assert springs["lwr_6_joint"]["value"] > 5.0 * springs["lwr_6_joint"]["standard_error"]


def with_plates_off(folder: Path) -> Path:
    """The training log of the squats, each axis of both plates off by 20 to 80 N."""
    rng = np.random.default_rng(0)
    with np.load(SHARED / "human_squats" / "squats1.npz") as log:
        fields = dict(log)
    off = rng.uniform(20.0, 80.0, (2, 3)) * rng.choice([-1.0, 1.0], (2, 3))
    fields["contact_wrench_world"] = fields["contact_wrench_world"] + np.pad(off, ((0, 0), (0, 3)))
    np.savez(folder / "off.npz", **fields)
    return folder / "off.npz"


def test_a_person_whose_feet_never_leave_the_plates_is_told_that_offset_and_mass_cannot_be_told_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, choice = (
        with_plates_off(tmp_path),
        "sensors={set: contacts, offsets: {contact_force: log, contact_moment: log}}",
    )
    overrides = f"logs.train=[{path}]", "logs.test=[]", choice
    metrics, parameters = identified(tmp_path / "run", "human_squats.yaml", *overrides)
    (message,) = [line for line in capsys.readouterr().err.splitlines() if ConfoundedWarning.__name__ in line]
    sensors, parameters_named = message.split(": confounded with ")
    for plate in ("calcn_l", "calcn_r"):
        (own,) = [part for part in sensors.split("; ") if plate in part]
        assert "fz" in own
    assert any(f" of {body['name']};" in parameters_named for body in parameters["bodies"])
    assert any("m" in part.split(" of ")[0].split(", ") for part in parameters_named.split("; "))

    vertical = [x for x in parameters["extras"] if x["component"] == "fz"]
    assert len(vertical) == 2
    for x in vertical:
        assert x["told_apart"] is False
        assert x["inflation"] > 3.0 * INFLATION_LIMIT
        assert any(name.endswith((" m", " mcx", " mcy", " mcz")) for name in x["mixed_with"])
    assert metrics["total_mass_separable_from_offsets"] is False
    verdicts = {body["name"]: body["verdict"]["m"] for body in parameters["bodies"]}
    assert "identified" not in verdicts.values()


GO2, LEGS = ROBOTS / "go2_description/urdf/go2.urdf", ("FL", "FR", "RL", "RR")


@pytest.mark.parametrize(("cutoff", "most"), [(10.0, 0.182), pytest.param(20.0, 0.200, marks=pytest.mark.study)])
def test_a_quadruped_in_the_air_is_predicted_with_actuators_that_can_exist(
    tmp_path: Path, cutoff: float, most: float
) -> None:
    """Rms over all joints of the second half [N m], fitted on the first, ridge too: 0.180 and 0.194 measured.

    Models that were identified in GPU simulators miss 0.206 and 0.227 at 10 Hz, 0.23 and 0.24 at 20 Hz; least squares
    of all bodies 0.200 and 0.225.
    """
    overrides = f"robot.urdf={GO2}", f"preprocessing.cutoff_hz={cutoff}"
    metrics, parameters = identified(tmp_path / "go2", "go2_in_air.yaml", *overrides)
    assert metrics["test"]["nullspace_rms"] <= most
    assert metrics["violations"] == []
    armature = {x["name"]: x["value"] for x in parameters["extras"] if x["what"] == "armature"}
    assert len(armature) == 12
    assert 0.0 <= min(armature.values()) < max(armature.values()) < 0.045  # 0.001 to 0.043 by others
    legs = np.array([[armature[f"{leg}_{joint}_joint"] for joint in ("hip", "thigh", "calf")] for leg in LEGS])
    assert (np.diff(np.median(legs, axis=0)) > 0.005).all(), "calves are geared down most"
    assert np.ptp(legs, axis=0).max() < 0.015, "the four legs are alike"
