"""Commands on several files of one recording, and on logs with gaps: what they find is what one whole file gives."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import FAST_ESTIMATOR, shortened_demo

from torchid.cli import main
from torchid.config import load_config
from torchid.errors import TorchidWarning
from torchid.logs import read_log

FIELDS = {
    "motion": ("joint_names", "joint_position", "base_quat_wxyz", "base_position_world"),
    "plates": ("contact_names", "contact_active", "contact_wrench_local"),
    "torques": ("joint_names", "joint_torque"),
}
JOINED = {"files": ["motion.npz", {"file": "plates.npz", "shift_s": -3.0}, "torques.npz"]}
NAME = "motion.npz + plates.npz@-3.0s + torques.npz"


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo with its training log in three files, of which the plates have a clock of their own."""
    folder = shortened_demo(tmp_path / "demo", 300)
    with np.load(folder / "sway_train.npz") as log:
        for name, fields in FIELDS.items():
            shift = 3.0 if name == "plates" else 0.0
            np.savez(folder / f"{name}.npz", time=log["time"] + shift, **{field: log[field] for field in fields})
    monkeypatch.chdir(folder)
    return folder


def identified(out: str, train: list[Any], test: list[Any], *overrides: str) -> dict[str, Any]:
    given = [f"logs.{name}={json.dumps(of)}" for name, of in (("train", train), ("test", test))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert main(["identify", "-v", "quadruped.yaml", f"output={out}", *given, *overrides]) == 0
    found: dict[str, Any] = json.loads(Path(out, "metrics.json").read_text())
    return found


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_fit_of_several_files_is_that_of_the_whole_log(demo: Path) -> None:
    whole = identified("runs/whole", ["sway_train.npz[:2]"], ["sway_train.npz[2:]"])
    joined = identified("runs/joined", [JOINED | {"to": 2}], [JOINED | {"from": 2}])
    assert Path("runs/joined/parameters.json").read_bytes() == Path("runs/whole/parameters.json").read_bytes()
    for key in ("train", "test", "cross_validation", "samples", "rank"):
        assert joined[key] == whole[key], key

    assert main(["evaluate", "runs/joined", "--log", f"{NAME}[2:]"]) == 0
    name = "motion + plates + torques[2:]"
    evaluated = json.loads((demo / f"runs/joined/evaluation/{name}/metrics.json").read_text())
    for group, value in evaluated[name]["identified"].items():
        assert value == pytest.approx(joined["test"][group], rel=1e-9), group
    assert load_config("runs/joined/config.yaml").logs.train == [demo / f"{NAME}[:2]"]


def test_several_files_are_checked_converted_and_compressed(demo: Path) -> None:
    assert main(["convert", NAME, "one.h5"]) == 0
    whole, one = read_log("sway_train.npz"), read_log("one.h5")
    for name, x in whole.arrays().items():
        assert np.array_equal(x, one.arrays()[name], equal_nan=True), name
    assert main(["check", f"{NAME}[0.5:2.5]", "--urdf", "quadruped.urdf"]) == 0
    train = f"logs.train={json.dumps([JOINED])}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert main(["check", "quadruped.yaml", train]) == 0
        assert main(["compress", "quadruped.yaml", train, "--output", "factors"]) == 0
    assert Path("factors/motion + plates + torques.factor").is_file()


def test_what_several_files_are_not_for_is_refused(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = f"logs.train={json.dumps([JOINED])}", "preprocessing.memory_gb=1e-4"
    assert "file: several files with " in refusal(capsys, "identify", "quadruped.yaml", *large)
    assert "this is an input, or in an input folder" in refusal(capsys, "convert", NAME, "plates.npz", "--overwrite")


def test_no_sample_of_the_first_file_is_used_twice(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = "motion.npz + torques.npz + plates.npz@-3"
    error = refusal(capsys, "identify", "quadruped.yaml", f"logs.train={json.dumps([NAME + '[:2]', other + '[1:]'])}")
    assert "share samples; accepted: each sample once" in error
    train, test = (
        f"logs.{name}={json.dumps([log])}" for name, log in (("train", NAME + "[:2]"), ("test", other + "[1:]"))
    )
    fast = f"estimator={json.dumps(FAST_ESTIMATOR)}"
    assert main(["identify", "quadruped.yaml", train, test, fast, "output=runs/x"]) == 0
    assert f"{other}[1:] is also used for the fit" in capsys.readouterr().err
