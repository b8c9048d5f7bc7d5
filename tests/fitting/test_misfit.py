"""Whether a model explains the forces: by the noise that is stated, and by residuals that are alike."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from repository import DEMO

from torchid.cli import main
from torchid.fitting.misfit import Misfit
from torchid.fitting.noise import GroupNoise

UNPHYSICAL = "ignore::torchid.errors.TorchidWarning"


def test_a_model_explains_what_noise_would_leave_and_no_more() -> None:
    good = Misfit(residual=0.33, expected=0.32, lack_of_fit=1.1, error_growth=1.0, groups=())
    assert good.explained
    assert str(good) == ""
    torque = GroupNoise("joint_torque", "N m", "stated", 0.5, 0.4)
    more = replace(good, residual=0.8, groups=(torque,))
    assert not more.explained
    assert str(more) == (
        "residuals are 2.5 times what the stated noise leaves; most in joint_torque 0.4 N m where 0.16 are expected"
    )
    assert replace(more, expected=None).explained, "estimated noise is what the residuals show"
    alike = replace(good, expected=None, lack_of_fit=4.0)
    assert not alike.explained
    assert str(alike) == "neighbouring residuals agree 4 times as much as those of noise"
    assert replace(alike, lack_of_fit=None).explained


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
        ]
        assert main([*command, "preprocessing.cache_gb=0"]) == 0
        told[fitted] = json.loads((run / "metrics.json").read_text()), capsys.readouterr().out
    good, lacking = told["true"][0]["misfit"], told["false"][0]["misfit"]
    assert good["explained"]
    assert good["message"] == ""
    assert told["true"][0]["residual_std"] == pytest.approx(good["expected_residual_std"], rel=0.05)
    assert 0.7 < good["lack_of_fit"] < 1.3
    assert "NOT EXPLAINED" not in told["true"][1]
    assert not lacking["explained"]
    assert "most in joint_torque" in lacking["message"]
    assert told["false"][1].startswith("NOT EXPLAINED: the model does not explain these forces: residuals are 11 times")
