"""Entries of `logs` that are parts of a recording: ranges, folds, patterns of both, and samples with two uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from torchid.config import dump_config, inputs_of, load_config
from torchid.config.logs import LogsConfig
from torchid.errors import ConfigError, TorchidWarning, UnknownNameError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.npz", "b.npz", "c.h5"):
        (tmp_path / name).touch()
    return tmp_path


def load(folder: Path, *overrides: str, sgd: bool = False, **named: Any) -> LogsConfig:
    """Logs of an experiment file beside them."""
    settings: dict[str, Any] = {"robot": {"urdf": "r.urdf"}, "logs": named, "sensors": "full", "output": "out"}
    if sgd:
        settings["estimator"] = {"name": "sgd"}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    return load_config(folder / "experiment.yaml", overrides).logs


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


def test_one_recording_trains_and_tests(folder: Path) -> None:
    logs = load(folder, train=["a.npz[0:30]"], test=["a.npz[30:]"])
    assert (names(logs.train), names(logs.test)) == (["a.npz[0:30]"], ["a.npz[30:]"])
    assert logs.files == [folder / "a.npz"]


def test_numbers_of_recordings_stand_for_each_of_them(folder: Path) -> None:
    logs = load(folder, train=["a.npz[#0:3]", "a.npz[#5]"], test=["*.npz[#3]"])
    assert names(logs.train) == ["a.npz[#0]", "a.npz[#1]", "a.npz[#2]", "a.npz[#5]"]
    assert names(logs.test) == ["a.npz[#3]", "b.npz[#3]"]
    with pytest.raises(ConfigError, match=r"a.npz\[#1\] is given twice"):
        load(folder, train=["a.npz[#0:3]", "a.npz[#1]"])
    with pytest.raises(ConfigError, match=r"a.npz and .*a.npz\[#1\] share samples"):
        load(folder, train=["a.npz", "a.npz[#1]"])


def test_a_mapping_says_the_same_in_words(folder: Path) -> None:
    entries = [{"file": "a.npz", "from": 0, "to": 30.5}, {"file": "b.npz", "from": -10}, {"file": "c.h5", "to": "80%"}]
    assert names(load(folder, train=entries).train) == ["a.npz[0:30.5]", "b.npz[-10:]", "c.h5[:80%]"]
    assert names(load(folder, train=[{"file": "a.npz"}]).train) == ["a.npz"]


def test_a_fold_and_what_is_left_without_it_make_up_the_log(folder: Path) -> None:
    def split(fold: int, **of: int) -> tuple[list[str], list[str]]:
        entry = {"file": "a.npz"} | of
        logs = load(folder, train=[entry | {"without_fold": fold}], test=[entry | {"fold": fold}])
        return names(logs.train), names(logs.test)

    assert split(5) == (["a.npz[:80%]"], ["a.npz[80%:]"])
    assert split(1) == (["a.npz[20%:]"], ["a.npz[:20%]"])
    assert split(2) == (["a.npz[:20%]", "a.npz[40%:]"], ["a.npz[20%:40%]"])
    assert split(2, of=3) == (
        ["a.npz[:33.3333333333333%]", "a.npz[66.6666666666667%:]"],
        ["a.npz[33.3333333333333%:66.6666666666667%]"],
    )


def test_the_written_settings_name_the_parts_and_are_read_again(folder: Path) -> None:
    load(folder, train=[{"file": "*.npz", "without_fold": 3}])
    config = load_config(folder / "experiment.yaml")
    (folder / "again.yaml").write_text(dump_config(config))
    assert load_config(folder / "again.yaml").logs == config.logs
    assert inputs_of(config) == [folder / "r.urdf", folder / "a.npz", folder / "b.npz"]


@pytest.mark.parametrize(
    ("entry", "field", "message"),
    [
        ({"file": "a.npz", "form": 0}, "logs.train.0", "unknown name 'form'; accepted: from"),
        ({"from": 0}, "logs.train.0.file", "missing; accepted: a file name, or a mapping"),
        ({"file": 3}, "logs.train.0.file", "found 3; accepted: a file name, or a mapping"),
        ({"file": "a.npz", "from": [1]}, "logs.train.0.from", "found [1]; accepted: a time [s]"),
        ({"file": "a.npz", "from": "x"}, "logs.train", "'[x:]' is no range, and no such file exists"),
        ({"file": "a.npz", "fold": 6}, "logs.train.0.fold", "found 6; accepted: a whole number from 1 to 5"),
        ({"file": "a.npz", "fold": 0}, "logs.train.0.fold", "found 0; accepted: a whole number from 1 to 5"),
        ({"file": "a.npz", "fold": 1, "of": 1}, "logs.train.0.of", "found 1; accepted: a whole number from 2"),
        ({"file": "a.npz", "of": 5}, "logs.train.0", "of without fold; accepted: from and to; or fold"),
        ({"file": "a.npz", "fold": 1, "to": 3}, "logs.train.0", "fold and to together; accepted"),
        ({"file": "a.npz", "fold": 1, "without_fold": 3}, "logs.train.0", "fold and without_fold together"),
    ],
)
def test_a_mapping_that_says_no_part_is_refused_by_its_field(
    folder: Path, entry: dict[str, Any], field: str, message: str
) -> None:
    with pytest.raises((ConfigError, UnknownNameError)) as raised:
        load(folder, train=[entry])
    line = str(raised.value)
    assert line.startswith(f"{folder / 'experiment.yaml'}: {field}: ")
    assert message in line


def test_samples_that_are_fitted_and_tested_on_are_warned_of(folder: Path) -> None:
    overlapping = ({"train": ["a.npz[0:30]"], "test": ["a.npz[29:]"]}, {"train": ["a.npz[0:30]"], "test": ["a.npz"]})
    for named in overlapping:
        with pytest.warns(TorchidWarning, match="logs.test: .*a.npz.* is also used for the fit. Its errors are"):
            load(folder, **named)


def test_samples_that_are_given_twice_are_refused(folder: Path) -> None:
    for train in (["a.npz[0:30]", "a.npz[29:]"], ["a.npz", "a.npz[29:]"], ["*.npz", "a.npz[:1]"]):
        with pytest.raises(ConfigError, match="logs.train: .* and .* share samples; accepted: each sample once"):
            load(folder, train=train)
    with pytest.raises(ConfigError, match="is given twice"):
        load(folder, train=["a.npz[0:30]", "*.npz[0:30]"])
    with pytest.raises(ConfigError, match="logs.validation: .* is also used for the fit"):
        load(folder, sgd=True, train=["a.npz[0:30]"], validation=["a.npz[29:]"])


def test_factors_have_no_parts(folder: Path) -> None:
    (folder / "a.factor").touch()
    with pytest.raises(ConfigError, match="takes a part of factors, which have no samples"):
        load(folder, train=["a.factor[0:3]"])


def test_several_files_are_one_log_whose_name_says_which(folder: Path) -> None:
    (folder / "b").mkdir()
    joined = {"files": ["a.npz", {"file": "c.h5", "shift_s": 0.12}, "b/d.npz", "../e.npz"]}
    logs = load(folder, train=[joined | {"from": 0, "to": 30}], test=[joined | {"fold": 5}])
    elsewhere = folder.parent / "e.npz"
    name = f"{folder}/a.npz + c.h5@0.12s + b/d.npz + {elsewhere}"
    assert [str(path) for path in (*logs.train, *logs.test)] == [f"{name}[0:30]", f"{name}[80%:]"]
    assert logs.files == [folder / "a.npz", folder / "c.h5", folder / "b/d.npz", elsewhere]
    (folder / "again.yaml").write_text(dump_config(load_config(folder / "experiment.yaml")))
    assert load_config(folder / "again.yaml").logs == logs


@pytest.mark.parametrize(
    ("entry", "found"),
    [
        ({"files": ["a.npz"]}, r"logs.train.0.files: one file; accepted: several files as one log.*file for a single"),
        ({"files": []}, r"logs.train.0.files: found \[\]"),
        ({"files": "a.npz"}, "logs.train.0.files: found 'a.npz'"),
        ({"files": ["a.npz", 3]}, "logs.train.0.files.1: found 3"),
        ({"files": ["a.npz", "b.npz + c.h5"]}, r"logs.train.0.files.1: found '.*b.npz \+ c.h5'"),
        ({"files": ["a.npz", {"shift_s": 3}]}, r"logs.train.0.files.1: found \{'shift_s': 3\}"),
        ({"files": ["a.npz", {"file": "b.npz", "shift": 3}]}, "logs.train.0.files.1: unknown name 'shift'"),
        (
            {"files": ["a.npz", {"file": "b.npz", "shift_s": "3 s"}]},
            "files.1.shift_s: found '3 s'; accepted: a time shift",
        ),
        ({"files": ["a.npz", {"file": "b.npz", "shift_s": True}]}, "files.1.shift_s: found True"),
        ({"files": ["a.npz", "b.npz"], "file": "c.h5"}, "logs.train.0: both file and files"),
        ({"files": ["a.npz", "*.h5"]}, r"logs.train: .*\*.h5 has a pattern; accepted: file names without patterns"),
    ],
)
def test_several_files_that_make_no_log_are_refused(folder: Path, entry: dict[str, Any], found: str) -> None:
    with pytest.raises((ConfigError, UnknownNameError), match=found):
        load(folder, train=[entry])


def test_a_range_without_quotes_in_a_list_is_refused_with_how_to_write_it(folder: Path) -> None:
    accepted = 'names with brackets take quotes in a list: ["walk.npz[0:30]"]'
    with pytest.raises(ConfigError) as raised:
        load(folder, "logs.train=[a.npz[0:3]]", train=["a.npz"])
    assert accepted in str(raised.value)
    (folder / "other.yaml").write_text("logs: {train: [a.npz[0:3]]}\n")
    with pytest.raises(ConfigError) as raised:
        load_config(folder / "other.yaml")
    assert accepted in str(raised.value)


def test_a_pattern_whose_range_is_the_end_of_a_file_is_refused(folder: Path) -> None:
    (folder / "a.npz[0:3]").touch()
    with pytest.raises(ConfigError, match=r"the brackets may be a range or part of the file name a.npz\[0:3\]"):
        load(folder, train=["*.npz[0:3]"])
