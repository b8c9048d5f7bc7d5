"""`preprocessing.contact_threshold` in the commands, on the demo's quadruped without flags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import DEMO, NO_TERMS
from motions import value
from refusals import refusal, refused
from run_folders import document, identified

from torchid.cli import main
from torchid.commands.check import check_experiment
from torchid.config import load_config
from torchid.errors import ConfigError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, read_log, write_log
from torchid.problem import Samples
from torchid.reading.log_reader import LogReader

pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
TOUCH = 0.1  # [N], above which there are exactly the samples in which the simulator lets a foot touch
FULL = {"set": "full", "noise": {"joint_torque": 0.1, "contact_force": 0.5, "contact_moment": 0.05}}
KEY = "preprocessing.contact_threshold"


def unflagged(log: Log) -> Log:
    return replace(log, contact_active=None)


def experiment(
    folder: Path, suffix: str = ".npz", change: Callable[[Log], Log] = unflagged, **preprocessing: Any
) -> Path:
    """The demo's experiment with changed logs and all sensors."""
    folder.mkdir(exist_ok=True)
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    for name in ("train", "test"):
        write_log(change(read_log(DEMO / f"sway_{name}.npz")), folder / f"{name}{suffix}")
        settings["logs"][name] = [f"{name}{suffix}"]
    settings["robot"]["urdf"] = str(DEMO / "quadruped.urdf")
    settings["estimator"]["ridge"] = 0.01
    settings["preprocessing"] |= {"contact_margin_s": 0.02} | preprocessing
    settings |= {"sensors": FULL, "actuators": NO_TERMS, "output": str(folder / "run")}
    (folder / "run.yaml").write_text(yaml.safe_dump(settings))
    return folder / "run.yaml"


def samples_of(file: Path) -> Samples:
    """The samples of the training log."""
    setup = set_up(load_config(file))
    return LogReader(setup).read(setup.config.logs.train, setup.sensors)[0]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run with the simulator's flags."""
    folder = tmp_path_factory.mktemp("simulated")
    assert main(["identify", str(experiment(folder, change=lambda log: log))]) == 0
    return folder / "run"


def test_a_fit_without_flags_is_that_with_the_same_flags(tmp_path: Path, simulated: Path) -> None:
    assert main(["identify", str(experiment(tmp_path, ".csv", contact_threshold=TOUCH))]) == 0
    assert document(tmp_path / "run", "parameters") == document(simulated, "parameters")


def test_wrong_flags_are_replaced_and_not_rejected(tmp_path: Path) -> None:
    def late(log: Log) -> Log:
        return replace(log, contact_active=np.roll(value(log.contact_active), 25, axis=0))

    file = experiment(tmp_path, change=late)
    assert any(one.field == "contact_active" for one in check_experiment(file)[0].findings)
    file = experiment(tmp_path, change=late, contact_threshold=TOUCH)
    assert not any(one.field == "contact_active" for one in check_experiment(file)[0].findings)
    right = samples_of(experiment(tmp_path / "right", change=lambda log: log))
    np.testing.assert_array_equal(samples_of(file).active, right.active)


def test_settings_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    def said(**preprocessing: Any) -> Callable[[], object]:
        return lambda: set_up(load_config(experiment(tmp_path, **preprocessing)))

    place = f"{tmp_path / 'run.yaml'}: {KEY}"
    refused(
        said(contact_threshold={"above": 10, "below": 20}),
        f"{place}.below: 20 N is more than above (10 N)",
        ConfigError,
    )
    refused(said(contact_threshold=10, detect_contacts=True), f"{place}: preprocessing.detect_contacts m", ConfigError)
    refused(said(contact_threshold=-1), f"{place}.above: ", ConfigError)
    refused(said(contact_threshold={"below": 20}), f"{place}.above", ConfigError)
    assert "a force [N], or a mapping" in refused(said(contact_threshold="30N"), f"{place}: found '30N'", ConfigError)
    start = f"{tmp_path / 'run.yaml'}: preprocessing.zero_in_air"
    refused(said(zero_in_air="contacts"), start, ConfigError)
    assert "below" in refused(said(contact_threshold={"above": 2, "belw": 1}), f"{place}: unknown name 'belw'")
    settings = load_config(experiment(tmp_path, contact_threshold=30)).preprocessing.contact_threshold
    assert settings is not None
    assert (settings.above, settings.below) == (30.0, None)


# -------------------------------------------------------------------------------------------------- zeroing in the air


def drifted(log: Log, size: float = 10.0) -> Log:
    """With offsets of forces of a size [N] that every foot has for itself."""
    offset = size * np.random.default_rng(3).normal(size=(4, 6)) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    return replace(log, contact_wrench_local=value(log.contact_wrench_local) + offset)


def test_a_fit_of_zeroed_sensors_is_that_of_sensors_without_offsets(tmp_path: Path, simulated: Path) -> None:
    file = experiment(tmp_path, change=drifted, zero_in_air=True)
    assert main(["identify", str(file)]) == 0
    np.testing.assert_allclose(identified(tmp_path / "run"), identified(simulated), rtol=0.0, atol=1e-9)


def test_offsets_have_one_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = experiment(tmp_path, change=lambda log: log, zero_in_air=True)
    line = refusal(["identify", str(file), "sensors.offsets={contact_moment: log}"], tmp_path, capsys)
    assert "sensors.offsets.contact_moment: preprocessing.zero_in_air subtracts the same" in line
