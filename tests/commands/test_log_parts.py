"""Commands on parts of one recording: what they find is what files of those parts would give."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from demo import shortened_demo
from large import tensors

from torchid.cli import main
from torchid.commands.compress import compress
from torchid.config import load_config
from torchid.errors import ConfigError, TorchidWarning
from torchid.fitting.experiment import set_up
from torchid.fitting.factor_files import read_factors
from torchid.logs import read_log, write_log
from torchid.problem import Samples
from torchid.reading.log_reader import LogReader


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo, and files of the first and the last three seconds of its training log."""
    folder = shortened_demo(tmp_path_factory.mktemp("parts") / "demo", 600)
    log = read_log(folder / "sway_train.npz")
    write_log(log.select(slice(0, 300)), folder / "first.npz")
    write_log(log.select(slice(300, None)), folder / "last.npz")
    return folder


def read(demo: Path, logs: list[str], *overrides: str) -> list[Samples]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        config = load_config(demo / "quadruped.yaml", overrides)
        setup = set_up(replace(config, logs=replace(config.logs, train=[demo / name for name in logs])))
        return LogReader(setup, demo).read(setup.config.logs.train, None)


@pytest.mark.parametrize(
    "settings",
    [
        ("preprocessing.cutoff_hz=8",),
        ("preprocessing={cutoff_hz: 8, sample_rate_hz: 50, contact_margin_s: 0.05}",),
        ("preprocessing.exclude_rejected=true",),
    ],
)
def test_no_filter_carries_samples_from_one_part_into_the_other(demo: Path, settings: tuple[str, ...]) -> None:
    parts = read(demo, ["sway_train.npz[:3]", "sway_train.npz[3:]"], *settings)
    files = read(demo, ["first.npz", "last.npz"], *settings)
    for part, file in zip(parts, files, strict=True):
        assert tensors(part).keys() == tensors(file).keys()
        for name, x in tensors(part).items():
            assert torch.equal(x.nan_to_num(), tensors(file)[name].nan_to_num()), name
    assert [Path(part.source).name for part in parts] == ["sway_train.npz[:3]", "sway_train.npz[3:]"]


def identified(demo: Path, out: Path, logs: dict[str, list[Any]], *overrides: str) -> dict[str, Any]:
    given = [f"logs.{name}={json.dumps(entries)}" for name, entries in logs.items()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert main(["identify", "-v", str(demo / "quadruped.yaml"), f"output={out}", *given, *overrides]) == 0
    found: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return found


def test_a_run_on_parts_is_that_on_files_of_them(demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(demo)
    parts = {"train": ["sway_train.npz[:3]"], "test": ["sway_train.npz[3:]"]}
    of_parts = identified(demo, tmp_path / "parts", parts)
    of_files = identified(demo, tmp_path / "files", {"train": ["first.npz"], "test": ["last.npz"]})
    for key in ("train", "test", "cross_validation", "samples", "rank"):
        assert of_parts[key] == of_files[key], key
    assert main(["evaluate", str(tmp_path / "parts"), "--log", "sway_train.npz[3:]"]) == 0
    evaluated = json.loads((tmp_path / "parts/evaluation/sway_train[3:]/metrics.json").read_text())
    for name, value in evaluated["sway_train[3:]"]["identified"].items():
        assert value == pytest.approx(of_parts["test"][name], rel=1e-9), name


def test_parts_that_turn_out_to_overlap_are_warned_of_or_refused(demo: Path, tmp_path: Path) -> None:
    def analyzed(train: str, test: str) -> None:
        from torchid.commands.identify import identify

        overrides = [f"logs={{train: {train}, test: {test}}}".replace("sway", f"{demo}/sway"), f"output={tmp_path}/x"]
        identify(load_config(demo / "quadruped.yaml", [*overrides, "overwrite=true"]))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        warnings.filterwarnings("error", "logs.test")
        analyzed('["sway_train.npz[:2]"]', '["sway_train.npz[-4:]"]')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        analyzed('["sway_train.npz[:3]"]', '["sway_train.npz[-4:]"]')
    assert any("sway_train.npz[-4:] is also used for the fit" in str(one.message) for one in caught)
    with pytest.raises(ConfigError, match="logs.train: .* share samples"):
        analyzed('["sway_train.npz[:3]", "sway_train.npz[-4:]"]', "[]")


@pytest.mark.parametrize("command", ["identify", "analyze", "check"])
def test_a_range_outside_of_the_log_ends_in_one_line(
    demo: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(demo / "quadruped.yaml"), f"output={tmp_path / 'run'}", f"logs.train=['{demo}/first.npz[3:9]']"]
    assert main([command, *arguments]) == 2
    line = capsys.readouterr().err.strip()
    assert line == (
        f"torchid: {demo}/first.npz[3:9]: time range: [3:9], but the log lasts 3 s (300 samples); "
        "accepted: a range within 0 to 3 s with samples"
    )
    assert not (tmp_path / "run").exists()


def test_parts_are_compressed_to_files_of_their_own(demo: Path, tmp_path: Path) -> None:
    parts = [demo / f"sway_train.npz{text}" for text in ("[:3]", "[3:]")]
    config = load_config(demo / "quadruped.yaml", [f"logs.train={[*map(str, parts)]}", "logs.test=[]"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        found = compress(config, tmp_path / "factors")
    assert [one.name for one in found.files] == ["sway_train[:3].factor", "sway_train[3:].factor"]
    assert len({read_factors(tmp_path / "factors" / one.name).sha256 for one in found.files}) == 2


def test_a_part_is_checked_and_converted(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(demo)
    main(["check", "sway_train.npz[-2:]"])
    assert "200 samples" in " ".join(capsys.readouterr().out.split())
    assert main(["convert", "sway_train.npz[:3]", str(tmp_path / "x.h5")]) == 0
    assert len(read_log(tmp_path / "x.h5")) == 300
    assert main(["convert", "sway_train.npz[:3]", "sway_train.npz", "--overwrite"]) == 2  # which is read
