"""Factors by URL: the fit of the same files here, and one line with the URL where something is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
import yaml
from fleets import demo_fleet
from refusals import refusal

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.logs import remote

pytestmark = [
    pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.NumericalWarning"),
]
BUCKET = "memory://bucket/robot"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_fleet(tmp_path_factory.mktemp("fleet") / "demo")


@pytest.fixture
def fleet(made: Path) -> Iterator[Path]:
    """A folder with an experiment of factors, which are in memory too."""
    memory = fsspec.filesystem("memory")
    for path in (made / "factors").glob("*.factor"):
        memory.pipe(f"/bucket/robot/{path.name}", path.read_bytes())
    yield made
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]


def files_of(fleet: Path, *overrides: str) -> list[str]:
    return [str(path) for path in load_config(fleet / "experiment.yaml", overrides).logs.train]


@pytest.mark.parametrize(
    ("pattern", "names"),
    [("*.factor", ("test", "train")), ("sway_t*.factor", ("test", "train")), ("sway_t????.factor", ("train",))],
)
def test_a_pattern_stands_for_all_files_that_match(fleet: Path, pattern: str, names: tuple[str, ...]) -> None:
    found = files_of(fleet, f"logs.train=[{BUCKET}/{pattern}]")
    assert found == [f"{BUCKET}/sway_{name}.factor" for name in names]


def test_files_here_have_a_url_too(fleet: Path) -> None:
    names = [path.name for path in sorted((fleet / "factors").glob("*.factor"))]
    assert files_of(fleet, f"logs.train=[file://{fleet}/factors/*.factor]") == [
        f"file://{fleet}/factors/{name}" for name in names
    ]


def test_factors_elsewhere_give_the_fit_of_factors_here(fleet: Path, tmp_path: Path) -> None:
    runs = {"here": [], "memory": [f"logs.train=[{BUCKET}/*.factor]"]}
    for name, overrides in runs.items():
        assert main(["identify", str(fleet / "experiment.yaml"), f"output={tmp_path / name}", *overrides]) == 0
    here, there = ((tmp_path / name / "parameters.json").read_bytes() for name in runs)
    assert there == here
    config = yaml.safe_load((tmp_path / "memory" / "config.yaml").read_text())
    assert config["logs"]["train"] == [f"{BUCKET}/sway_test.factor", f"{BUCKET}/sway_train.factor"]
    again = ["identify", str(tmp_path / "memory" / "config.yaml"), f"output={tmp_path / 'again'}"]
    assert main(again) == 0
    assert (tmp_path / "again" / "parameters.json").read_bytes() == here


def test_uses_of_a_run_fetch_nothing(fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's run folder may name any URL."""
    run = tmp_path / "run"
    assert main(["identify", str(fleet / "experiment.yaml"), f"output={run}", f"logs.train=[{BUCKET}/*.factor]"]) == 0
    monkeypatch.setattr(remote, "_file_system", lambda path: pytest.fail(f"{path} was asked for"))
    config = yaml.safe_load((run / "config.yaml").read_text())
    for url in config["logs"]["train"][0], "https://elsewhere.org/*.factor":
        config["logs"]["train"] = [url]
        (run / "config.yaml").write_text(yaml.safe_dump(config))
        log = str(fleet / "sway_test.npz")
        assert main(["evaluate", str(run), "--log", log, "--output", str(tmp_path / "out"), "--overwrite"]) == 0
        assert main(["export", str(run), "--format", "json", "--output", str(tmp_path / "x.json"), "--overwrite"]) == 0
        assert main(["report", str(run)]) == 0


def test_a_library_call_takes_a_url(fleet: Path) -> None:
    name = "sway_test.factor"
    here, there = torchid.read_factors(fleet / "factors" / name), torchid.read_factors(f"{BUCKET}/{name}")
    assert there.log.source == f"{BUCKET}/{name}"
    assert there.sha256 == here.sha256


REFUSED = {
    "missing": (f"{BUCKET}/none.factor", f"{BUCKET}/none.factor: file: no such file; accepted: a whole .factor file"),
    "no match": (f"{BUCKET}/run_*.factor", f"logs.train: no file matches {BUCKET}/run_*.factor; "),
    "damaged": (f"{BUCKET}/bad.factor", f"{BUCKET}/bad.factor: file: cannot be read (BadZipFile"),
    "no such place": (
        "nowhere://bucket/a.factor",
        "nowhere://bucket/a.factor: file: cannot be read (ValueError: Proto",
    ),
    "no package": ("abfs://bucket/a.factor", "abfs://bucket/a.factor: file: needs a package that is not installed ("),
    "a pattern without the package": ("abfs://bucket/*.factor", "abfs://bucket/*.factor: file: needs a package that"),
    "a log": ("memory://bucket/a.npz", "logs.train: memory://bucket/a.npz, by URL; accepted: .factor files by URL; "),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_by_its_url(fleet: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    url, expected = REFUSED[case]
    fsspec.filesystem("memory").pipe("/bucket/robot/bad.factor", b"no archive")
    message = refusal(["identify", str(fleet / "experiment.yaml"), f"logs.train=[{url}]"], fleet, capsys)
    assert expected in message, message


def test_a_file_elsewhere_that_is_too_large_is_not_fetched_whole(
    fleet: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchid.fitting.factor_files.MAX_ARRAYS", 1000)
    url = f"{BUCKET}/sway_test.factor"
    message = refusal(["identify", str(fleet / "experiment.yaml"), f"logs.train=[{url}]"], fleet, capsys)
    assert message.startswith(f"torchid: {url}: file: more than 1000 bytes; accepted: ")


@pytest.mark.parametrize(
    "key", ["logs.test=[memory://bucket/a.npz]", "robot.urdf=s3://bucket/a.urdf", "output=s3://b/run"]
)
def test_other_keys_take_no_url(fleet: Path, capsys: pytest.CaptureFixture[str], key: str) -> None:
    message = refusal(["identify", str(fleet / "experiment.yaml"), key], fleet, capsys)
    assert ", a URL; accepted: a path" in message


def test_compress_writes_to_no_url(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refusal(["compress", str(fleet / "logs.yaml"), "--output", "s3://bucket/factors"], fleet, capsys)
    assert message.startswith("torchid: s3://bucket/factors: output: a URL; accepted: a folder on this machine")


def test_nothing_is_left_of_what_was_fetched(fleet: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = remote.RemoteFile.at(f"{BUCKET}/sway_test.factor")
    with remote.local_copy(path, "a file", 2**30) as copy:
        assert copy.read_bytes() == (fleet / "factors" / path.name).read_bytes()
        assert copy.parent == tmp_path
    assert not [*tmp_path.iterdir()]
