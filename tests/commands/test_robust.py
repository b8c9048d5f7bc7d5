"""Robust fits by the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from refusals import refusal

from torchid.cli import main


@pytest.fixture
def tampered(tmp_path: Path) -> Path:
    """The demo's experiment file; one torque sensor of its training log has spikes."""
    folder = shortened_demo(tmp_path / "demo", 250)
    with np.load(folder / "sway_train.npz") as log:
        fields = dict(log.items())
    fields["joint_torque"][::25, 3] += 50.0
    np.savez(folder / "sway_train.npz", **fields)
    return folder / "quadruped.yaml"


@pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")
def test_a_run_says_how_its_robust_fit_went_and_whether_it_settled(
    tampered: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tampered.parent / "run"
    assert main(["identify", "-v", str(tampered), f"output={output}", "estimator.robust={loss: tukey, passes: 1}"]) == 0
    printed = capsys.readouterr()
    assert "of the weight kept, 1 passes" in printed.out
    assert "NumericalWarning: " in printed.err
    assert "estimator.robust: not converged after 1 passes. Raise its passes." in printed.err
    robust = json.loads((output / "metrics.json").read_text())["robust"]
    assert (robust["loss"], robust["tuning"], robust["passes"], robust["converged"]) == ("tukey", 4.685, 1, False)
    assert 0.9 < robust["mean_weight"] < 1.0


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("estimator.name=sgd", "estimator.robust"),
        ("estimator.robust=cauchy", "huber"),
        ("estimator.robust={loss: huber, tuning: 0}", "estimator.robust.tuning"),
        ("estimator.robust={loss: huber, passes: 0}", "estimator.robust.passes"),
        ("estimator.robust={tuning: 2}", "loss"),
        ("estimator.robust={loss: tukey, pases: 2}", "passes"),
    ],
)
def test_robust_settings_that_make_no_sense_are_refused(
    tampered: Path, capsys: pytest.CaptureFixture[str], override: str, expected: str
) -> None:
    arguments = ["identify", str(tampered), "estimator.robust=tukey", override]
    assert expected in refusal(arguments, tampered.parent, capsys)
