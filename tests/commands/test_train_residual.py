"""`scripts/train_residual.py`: networks beside the rigid body."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from script_calls import ROOT, call
from trainings import events_in

from torchid.config.experiment import ActuatorsConfig

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
