"""Samples in which a foot slips are dropped and counted, through the commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from refusals import refusal

from torchid.cli import main


@pytest.fixture(scope="module")
def dragged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo, where one leg was turned by hand for 0.4 s while its foot counts as standing."""
    file = shortened_demo(tmp_path_factory.mktemp("slip") / "demo", 300) / "quadruped.yaml"
    path = file.parent / "sway_train.npz"
    with np.load(path) as archive:
        log = dict(archive)
    joint = list(log["joint_names"]).index("front_left_thigh")
    x = np.clip((np.arange(len(log["time"])) - 200) / 40.0, 0.0, 1.0)
    log["joint_position"] = log["joint_position"].copy()
    log["joint_position"][:, joint] += 0.5 * 64.0 * (x * (1.0 - x)) ** 3
    np.savez(path, **log)
    return file


def samples(run: Path) -> int:
    return int(json.loads((run / "metrics.json").read_text())["samples"])


def test_they_are_dropped_and_a_line_counts_them_by_contact(
    dragged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, limit in (("all", "null"), ("auto", "auto")):
        assert main(["identify", str(dragged), f"preprocessing.max_slip={limit}", f"output={tmp_path / name}"]) == 0
        said = [line for line in capsys.readouterr().err.splitlines() if "samples dropped" in line]
        if name == "all":
            assert not said
            continue
        (line,) = said
        dropped = samples(tmp_path / "all") - samples(tmp_path / name)
        assert 25 <= dropped <= 60
        assert f"{dropped} of {samples(tmp_path / 'all')} samples dropped because contacts slip: " in line
        assert "front_left_foot in" in line
        assert line.count(" in ") == 1, "no other contact"


def test_feet_that_stand_lose_no_sample(dragged: Path, tmp_path: Path) -> None:
    logs = f"logs={{train: [{dragged.parent / 'sway_test.npz'}]}}"
    for name, limit in (("all", "null"), ("auto", "auto")):
        assert (
            main(["identify", str(dragged), logs, f"preprocessing.max_slip={limit}", f"output={tmp_path / name}"]) == 0
        )
    assert samples(tmp_path / "all") == samples(tmp_path / "auto")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("preprocessing.max_slip=0",), "preprocessing.max_slip: found 0; accepted: auto, null, or a number"),
        (
            ("preprocessing.max_slip=1e-9", "preprocessing.memory_gb=0.0001"),
            "or a contact slips; accepted: a larger preprocessing.max_slip",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_what_cannot_be_is_refused_in_one_line(
    dragged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], message: str
) -> None:
    command = ["identify", str(dragged), *more, f"output={tmp_path / 'run'}"]
    found = refusal(command, dragged.parent, capsys)
    assert message in found
