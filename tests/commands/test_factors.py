"""Factors of logs in place of the logs: the same fit, and what a run says then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import shortened_demo
from fleets import compressed, demo_fleet, fitted_twice, walks

import torchid
from torchid.cli import main
from torchid.commands.run_folder import Identification
from torchid.config import load_config
from torchid.fitting.factor_files import FactorFile, read_factors, write_factors
from torchid.problem.metrics import WHITENED

pytestmark = [
    pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.NumericalWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.ConfoundedWarning"),
    pytest.mark.filterwarnings("ignore:.*in the air:torchid.errors.TorchidWarning"),
]
SAME = 1e-12
KEPT = 150  # of 200 samples: the filter leaves out what it cannot see both sides of
OFFSETS = {"set": "full", "offsets": "log"}


def of_whitened(run: Identification) -> list[float]:
    """Whitened residuals of nominal and identified parameters, on the training logs and on held-out blocks."""
    assert run.validation is not None
    held_out = (run.validation.nominal, run.validation.identified)
    return [float(metrics.rms[WHITENED] or 0.0) for metrics in (*run.metrics["train"], *held_out)]


def assert_same(logs: Identification, factors: Identification) -> None:
    one, other = logs.estimate, factors.estimate
    assert np.abs(one.phi - other.phi).max() < SAME * np.abs(one.phi).max()
    assert (one.verdict == other.verdict).all()
    assert other.residual_std == pytest.approx(one.residual_std, rel=SAME)
    assert one.rank == other.rank
    assert one.rows == other.rows
    assert [x.extra.label for x in logs.extras] == [x.extra.label for x in factors.extras]
    for x, y in zip(logs.extras, factors.extras, strict=True):  # rounding grows as errors do by what confounds them
        assert abs(x.value - y.value) < SAME * x.extra.size * max(x.inflation, 1.0), x.extra.label
    assert logs.validation is not None
    assert factors.validation is not None
    assert logs.validation.folds == factors.validation.folds > 1
    assert of_whitened(factors) == pytest.approx(of_whitened(logs), rel=SAME)
    assert logs.samples == factors.samples
    assert {x.name: (x.samples, x.rows, x.base_rank) for x in logs.states} == {
        x.name: (x.samples, x.rows, x.base_rank) for x in factors.states
    }
    for kind in ("logs", "states"):
        one_kind, other_kind = (
            {Path(x.name).stem: x.bits for x in getattr(run.contributions, kind)} for run in (logs, factors)
        )
        assert other_kind == pytest.approx(one_kind, rel=1e-9)


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        pytest.param(("estimator={name: consistent, ridge: auto}",), marks=pytest.mark.slow("a search of the ridge")),
    ],
    ids=["least squares", "ridge auto"],
)
def test_the_demo_from_its_factor_is_the_demo_from_its_log(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    logs, factors = fitted_twice(shortened_demo(tmp_path / "demo", 600) / "quadruped.yaml", *overrides)
    assert_same(logs, factors)
    assert (logs.ridge is None) == (factors.ridge is None)
    if logs.ridge is not None and factors.ridge is not None:
        assert factors.ridge.ridge == logs.ridge.ridge
        assert factors.ridge.mean_square == pytest.approx(logs.ridge.mean_square, rel=SAME)
    for one, other in zip(logs.metrics["test"], factors.metrics["test"], strict=True):
        assert {key: x for key, x in other.rms.items() if x is not None} == pytest.approx(
            {key: x for key, x in one.rms.items() if x is not None}, rel=1e-10
        )


@pytest.mark.parametrize(
    ("machine", "seconds", "settings"),
    [
        ("arm", (2.0, 2.5, 2.0), {"actuators": {"armature": True, "torque_offset": True}}),
        pytest.param("biped", (2.0, 2.0), {"sensors": OFFSETS}, marks=pytest.mark.slow("offsets of every log")),
    ],
    ids=["arm, actuators", "biped"],
)
def test_several_logs_from_their_factors_are_fitted_as_from_the_logs(
    tmp_path: Path, machine: str, seconds: tuple[float, ...], settings: dict[str, Any]
) -> None:
    """With offsets of every log, readings in the air, whole logs held out, and noise that is estimated."""
    logs, factors = fitted_twice(walks(tmp_path, machine, seconds, **settings))
    assert_same(logs, factors)
    assert logs.noise.noise == factors.noise.noise
    assert [one.origin for one in logs.noise.groups] == [one.origin for one in factors.noise.groups]
    assert logs.misfit.expected is factors.misfit.expected is None


# ------------------------------------------------------------------------------------------------ what a run says then


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_fleet(tmp_path_factory.mktemp("fleet") / "demo")


@pytest.mark.slow("searches of a cutoff, a velocity and a tilt")
def test_what_was_left_to_the_logs_is_printed_and_taken_from_their_factors(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    auto = [str(fleet / "logs.yaml"), "preprocessing.cutoff_hz=auto", "actuators.stribeck=auto", "robot.base_tilt=auto"]
    assert main(["compress", *auto, "--output", str(tmp_path / "f")]) == 0
    printed = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines() if line.startswith("cutoff"))
    assert main(["identify", *auto, f"logs.train=[{tmp_path}/f/*.factor]", f"output={tmp_path / 'run'}"]) == 0
    written = load_config(tmp_path / "run" / "config.yaml")
    assert written.preprocessing.cutoff_hz == pytest.approx(float(printed["cutoff"]))
    settings = read_factors(tmp_path / "f" / "sway_train.factor").model.settings
    assert written.actuators.stribeck == settings.get("actuators.stribeck")
    tilt = ", ".join(map(repr, written.robot.tilt))
    assert tilt == settings.get("robot.base_tilt", "0.0, 0.0")


def test_the_table_of_files_says_what_is_in_them(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["compress", str(fleet / "logs.yaml"), "--output", str(tmp_path / "f")]
    assert main(line) == 0
    lines = capsys.readouterr().out.splitlines()
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "f").glob("*.factor")}
    found = read_factors(tmp_path / "f" / "sway_train.factor").log
    cells = [
        "sway_train.factor",
        str(KEPT),
        f"{sizes['sway_train.factor'] / 1e3:.0f}",
        str(found.rows),
        str(len(found.by_state)),
    ]
    assert lines[0] == f"2 logs ({2 * KEPT} samples) compressed to {sum(sizes.values()) / 1e6:.3g} MB of factors."
    assert cells in [line.split() for line in lines]


def test_a_file_reads_back_to_the_last_bit(fleet: Path, tmp_path: Path) -> None:
    path = fleet / "factors" / "sway_train.factor"
    found = read_factors(path)
    assert found.version == torchid.__version__
    assert found.duration == pytest.approx((KEPT - 1) * 0.01)
    write_factors(tmp_path / "again.factor", found)
    assert (tmp_path / "again.factor").read_bytes() == path.read_bytes()


def test_a_file_is_written_whole_or_not_at_all(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = read_factors(fleet / "factors" / "sway_train.factor")

    def interrupted(stream: Any, **arrays: Any) -> None:
        stream.write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_factors(tmp_path / "a.factor", found)
    with pytest.raises(KeyboardInterrupt):
        compressed(fleet / "logs.yaml", tmp_path / "f")
    assert list(tmp_path.iterdir()) == []


def test_only_factor_files_are_written_and_read(fleet: Path, tmp_path: Path) -> None:
    found: FactorFile = read_factors(fleet / "factors" / "sway_train.factor")
    with pytest.raises(torchid.TorchidError, match=r"extension '.npz'; accepted: .factor"):
        write_factors(tmp_path / "a.npz", replace(found))
    for name in ("missing.factor", "a.factor"):
        (tmp_path / "a.factor").mkdir(exist_ok=True)
        with pytest.raises(torchid.TorchidError, match="accepted: a complete .factor file"):
            read_factors(tmp_path / name)


def test_rejected_samples_are_left_out_when_logs_are_compressed(fleet: Path, tmp_path: Path) -> None:
    with np.load(fleet / "sway_train.npz") as log:
        fields = dict(log)
    fields["joint_torque"] = fields["joint_torque"].copy()
    fields["joint_torque"][100, 3] += 500.0
    np.savez(tmp_path / "spike.npz", **fields)
    overrides = [f"logs.train=[{tmp_path / 'spike.npz'}]", "preprocessing.exclude_rejected=true"]
    assert main(["compress", str(fleet / "logs.yaml"), "--output", str(tmp_path / "f"), *overrides]) == 0
    found = read_factors(tmp_path / "f" / "spike.factor")
    assert found.excluded > 0
    assert found.excluded + len(found.log) == KEPT
