"""`scripts/train_residual.py`: networks beside the rigid body."""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from script_calls import ROOT, call, script
from trainings import events_in

from torchid.config.experiment import ActuatorsConfig
from torchid.estimators import ResidualEffect

DEMO = str(ROOT / "torchid" / "demo" / "quadruped.yaml")

NO_TERMS = f"actuators={ActuatorsConfig.without_terms()}".replace("None", "null")


def test_networks_find_the_friction_that_the_model_lacks(tmp_path: Path) -> None:
    status, printed, _ = call(
        "train_residual", DEMO, "estimator.friction=false", NO_TERMS, "--epochs", "12", "--curves", str(tmp_path)
    )
    assert status == 0
    rows = [line for line in printed.splitlines() if "│" in line]
    alone, beside = (float(re.findall(r"\d+\.\d+", row)[1]) for row in rows)
    assert beside < 0.5 * alone
    assert {path.name for path in tmp_path.iterdir()} == {"rigid_bodies_alone", "with_networks"}
    for row, run in zip(rows, ("rigid_bodies_alone", "with_networks"), strict=True):
        events = events_in(tmp_path / run)
        unseen = [event.value for event in events.Scalars("loss_unseen/data")]
        assert len(unseen) == 12
        (final,) = events.Scalars("final/unseen_rms")
        assert final.value == pytest.approx(unseen[-1] ** 0.5, rel=1e-6)
        assert f"{final.value:.3f}" in row
        assert "_hparams_/session_start_info" in events.summary_metadata

    status, _, told = call("train_residual", DEMO, "--curves", str(tmp_path))
    assert status == 2
    assert told == f"train_residual: command line: --curves: {tmp_path} exists; accepted: a new folder\n"


def test_the_script_computes_where_it_is_told(tmp_path: Path) -> None:
    """The option counts, not the file; without a GPU it is refused before any work, with one it is used."""
    arguments = (DEMO, "device=cuda:99", "--epochs", "1", "--weight", "1", "--curves")
    status, _, told = call("train_residual", *arguments, str(tmp_path / "cpu"), "--device", "cpu")
    assert (status, told) == (0, "")
    status, _, told = call("train_residual", *arguments, str(tmp_path / "cuda"), "--device", "cuda")
    if torch.cuda.is_available():
        assert (status, told) == (0, "")
    else:
        assert status == 2
        assert "device: 'cuda' is not available here; accepted: cpu, cuda, cuda:0, ..." in told


def test_networks_start_at_no_force() -> None:
    q, v, a = (torch.randn(5, size, dtype=torch.float64) for size in (11, 10, 10))
    force = script("train_residual").JointNetworks(4)(q, v, a)
    assert force.shape == (5, 10)
    assert not force.any()


def test_without_unseen_logs_there_is_nothing_to_compare() -> None:
    status, _, told = call("train_residual", DEMO, "logs.test=[]")
    assert status == 2
    assert "logs.test: none" in told


def test_a_cutoff_that_is_left_to_the_logs_is_chosen(tmp_path: Path) -> None:
    auto = ("preprocessing.cutoff_hz=auto", "--epochs", "1", "--weight", "1")
    assert call("train_residual", DEMO, *auto, "--curves", str(tmp_path / "curves"))[::2] == (0, "")


def test_bodies_that_the_data_determine_nothing_of_have_no_standard_errors() -> None:
    effect = ResidualEffect(
        weight=1.0, choice=None, shares={}, rms={}, rigid_share=0.5, moved=np.zeros(2),
        moved_scaled=np.array([0.2, 0.1]), moved_errors=np.array([np.nan, 3.0]),
    )  # fmt: skip
    with redirect_stdout(StringIO()) as printed:
        script("train_residual").print_effect(effect, ("arm", "hand"))
    assert (
        "parameters moved most: arm (0.2 of its size), hand (0.1 of its size, 3 standard errors)" in printed.getvalue()
    )
