"""Factors of logs in place of the logs: the same fit, and one line for whatever does not belong together."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import shortened_demo
from fleets import WALKS, compressed, fitted, fitted_twice, walks
from hostile import examined
from hostile_logs import mutated
from refusals import refusal
from repository import DEMO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import torchid
from torchid.cli import main
from torchid.commands import Identification
from torchid.config import load_config
from torchid.fitting.factor_files import FactorFile, read_factors, write_factors
from torchid.problem.metrics import ERROR_GROUPS, WHITENED

pytestmark = [
    pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.NumericalWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.ConfoundedWarning"),
    pytest.mark.filterwarnings("ignore:.*in the air:torchid.errors.TorchidWarning"),
]
SAME = 1e-12
KEPT = 350  # of 400 samples: the filter leaves out what it cannot see both sides of
STATED = {"joint_torque": 1.0, "contact_force": 4.0, "contact_moment": 0.5, "base_force": 5.0, "base_moment": 1.0}
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
    assert all(abs(x.value - y.value) < SAME * x.extra.size for x, y in zip(logs.extras, factors.extras, strict=True))
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
    [(), ("estimator.ridge=auto",), ("estimator={name: consistent, ridge: 0.001}",)],
    ids=["least squares", "ridge auto", "consistent"],
)
def test_the_demo_from_its_factor_is_the_demo_from_its_log(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    shutil.copytree(DEMO, tmp_path / "demo")
    logs, factors = fitted_twice(tmp_path / "demo" / "quadruped.yaml", *overrides)
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
        ("arm", (6.0,), {}),
        ("arm", (3.0, 4.0, 3.0), {"actuators": {"armature": True, "torque_offset": True}}),
        ("biped", (4.0, 3.0, 6.0), {"sensors": OFFSETS}),
        ("biped", (8.0, 2.0, 2.0), {"sensors": OFFSETS, "estimator": {"name": "consistent", "ridge": 1e-3}}),
        ("biped", (4.0, 3.0, 6.0), {"sensors": OFFSETS, "estimator": {"ridge": "auto"}}),
    ],
    ids=["arm", "arm, actuators", "biped", "biped, consistent", "biped, ridge auto"],
)
def test_several_logs_from_their_factors_are_fitted_as_from_the_logs(
    tmp_path: Path, machine: str, seconds: tuple[float, ...], settings: dict[str, Any]
) -> None:
    """With offsets of every log, readings in the air, whole logs held out, and noise that is estimated."""
    logs, factors = fitted_twice(walks(tmp_path, machine, seconds, **settings))
    assert_same(logs, factors)
    assert logs.noise.noise == factors.noise.noise
    assert (logs.ridge is None) == (factors.ridge is None)
    if logs.ridge is not None and factors.ridge is not None:
        assert factors.ridge.ridge == logs.ridge.ridge


def test_files_of_two_calls_with_stated_noise_fit_as_those_of_one(tmp_path: Path) -> None:
    file = walks(tmp_path, "biped", (2.0, 2.0, 3.0), sensors=OFFSETS | {"noise": STATED})
    compressed(file, tmp_path / "one")
    compressed(file, tmp_path / "here", f"logs.train=[{tmp_path / WALKS[0]}]")
    compressed(file, tmp_path / "there", f"logs.train=[{tmp_path / WALKS[1]}, {tmp_path / WALKS[2]}]")
    names = [Path(name).with_suffix(".factor").name for name in WALKS]
    places = [tmp_path / place / name for place, name in zip(("here", "there", "there"), names, strict=True)]
    for name, place in zip(names, places, strict=True):
        assert (tmp_path / "one" / name).read_bytes() == place.read_bytes()
    together = fitted(file, "a", f"logs.train={[str(tmp_path / 'one' / name) for name in names]}")
    apart = fitted(file, "b", f"logs.train={[str(place) for place in places]}")
    assert np.array_equal(together.estimate.phi, apart.estimate.phi)
    assert_same(fitted(file, "c"), apart)


# ------------------------------------------------------------------------------------------------ what a run says then


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the demo cut short, as experiment.yaml, and factors of both of its logs."""
    folder = shortened_demo(tmp_path_factory.mktemp("fleet") / "demo", 400)
    settings = yaml.safe_load((folder / "quadruped.yaml").read_text())
    settings["sensors"]["noise"] |= {"base_force": 0.3, "base_moment": 0.1}
    settings |= {"output": str(folder / "run"), "estimator": {"ridge": 0.1}}
    settings["logs"] = {"train": ["sway_train.npz", "sway_test.npz"]}
    (folder / "logs.yaml").write_text(yaml.safe_dump(settings))
    assert main(["compress", str(folder / "logs.yaml"), "--output", str(folder / "factors")]) == 0
    settings["logs"] = {"train": ["factors/*.factor"]}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    return folder


def test_a_run_of_factors_says_what_it_can(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "run"
    assert main(["identify", str(fleet / "experiment.yaml"), f"output={output}"]) == 0
    printed = capsys.readouterr().out
    assert "What each log and contact state adds" in printed
    assert {path.name.split(".")[0] for path in output.glob("*.png")} == {
        "errors", "parameters", "identifiability", "contributions"
    }, "no figure of forces, which takes samples"  # fmt: skip
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["train"][WHITENED] > 0.0
    assert all(metrics["train"][f"{group}_rms"] is None for group in ERROR_GROUPS if group != WHITENED)
    assert metrics["identifiability"]["sensors"] == []
    assert metrics["samples"] == 2 * KEPT
    by_log = {Path(one["file"]).name: one for one in metrics["factors"]}
    assert set(by_log) == {"sway_train.factor", "sway_test.factor"}
    assert by_log["sway_train.factor"]["log"] == "sway_train.npz"
    config = load_config(output / "config.yaml")
    assert [path.name for path in config.logs.train] == ["sway_test.factor", "sway_train.factor"]
    assert {one["origin"] for one in metrics["noise"]["groups"]} == {"stated"}
    events = EventAccumulator(str(output))
    events.Reload()
    assert "descent/samples_per_second" not in events.Tags()["scalars"]
    assert main(["evaluate", str(output), "--log", str(fleet / "sway_test.npz")]) == 0


def test_the_table_of_files_says_what_is_in_them(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compress", str(fleet / "logs.yaml"), "--output", str(tmp_path / "f")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if ".factor" in line]
    size = (tmp_path / "f" / "sway_train.factor").stat().st_size
    found = read_factors(tmp_path / "f" / "sway_train.factor").log
    cells = ["sway_train.factor", str(KEPT), str(found.rows), str(len(found.by_state)), f"{size / 1e3:.0f}"]
    assert [x.strip() for x in lines[0].strip("│").split("│")] == cells


def test_nothing_is_replaced_but_what_torchid_wrote(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["compress", str(fleet / "logs.yaml"), "--output", str(tmp_path / "f")]
    assert main(line) == 0
    capsys.readouterr()
    assert "not empty; accepted: a new folder, or overwrite=true" in refusal(line, tmp_path, capsys)
    assert main([*line, "overwrite=true"]) == 0
    (tmp_path / "f" / "mine.factor").write_text("mine")
    capsys.readouterr()
    assert "mine.factor, which torchid did not write" in refusal([*line, "overwrite=true"], tmp_path, capsys)


def test_condemned_samples_are_left_out_when_logs_are_compressed(fleet: Path, tmp_path: Path) -> None:
    with np.load(fleet / "sway_train.npz") as log:
        fields = dict(log)
    fields["joint_torque"] = fields["joint_torque"].copy()
    fields["joint_torque"][100, 3] += 500.0
    np.savez(tmp_path / "spike.npz", **fields)
    overrides = [f"logs.train=[{tmp_path / 'spike.npz'}]", "preprocessing.exclude_condemned=true"]
    assert main(["compress", str(fleet / "logs.yaml"), "--output", str(tmp_path / "f"), *overrides]) == 0
    found = read_factors(tmp_path / "f" / "spike.factor")
    assert found.excluded > 0
    assert found.excluded + len(found.log) == KEPT


def test_an_implausible_fit_is_refused_without_a_look_for_samples(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with np.load(fleet / "sway_train.npz") as log:
        np.savez(tmp_path / "reversed.npz", **{**log, "joint_torque": -log["joint_torque"]})
    logs = f"logs.train=[{tmp_path / 'reversed.npz'}]"
    assert main(["compress", str(fleet / "logs.yaml"), logs, "--output", str(tmp_path / "f")]) == 0
    capsys.readouterr()
    looked: list[Path] = []
    monkeypatch.setattr("torchid.commands.plausibility.read_log_to_check", lambda path, *_: looked.append(path))
    factors = f"logs.train=[{tmp_path / 'f' / 'reversed.factor'}]"
    message = refusal(["identify", str(fleet / "experiment.yaml"), factors], tmp_path, capsys)
    assert "usual reasons: torques or wrenches of the opposite sign" in message
    assert looked == []


# ------------------------------------------------------------------------------------------------------------- refusals

REFUSED = {
    "sensors": (["sensors.set=full"], "sensors: without front_left_foot fx"),
    "other sensors": (["sensors.set=contacts", "sensors.on_base_lost=warn"], "sensors: without front_left_foot fx"),
    "filter": (["preprocessing.cutoff_hz=9"], "preprocessing.cutoff_hz: 8; accepted: 9, as in the experiment file"),
    "no filter": (["preprocessing.cutoff_hz=null"], "preprocessing.cutoff_hz: 8; accepted: none"),
    "margin": (["preprocessing.contact_margin_s=0.1"], "preprocessing.contact_margin_s: none; accepted: 0.1"),
    "extras": (["sensors.offsets=log"], "sensors.offsets: without offset of front_left_hip, by log"),
    "scales": (["sensors.scales=all"], "sensors.scales: without scale of front_left_hip, of all logs"),
    "actuators": (["actuators.armature=true"], "actuators: without armature of front_left_hip"),
    "sign": (["actuators.sign_width=0.1"], "actuators.sign_width: none; accepted: 0.1"),
    "contacts": (
        ["contacts=[{frame: front_left_foot, type: point}, {frame: front_right_foot, type: point}]"],
        "contacts: with rear_left_foot (point), rear_right_foot (point)",
    ),
    "contact type": (
        ["contacts=[{frame: front_left_foot, type: flat}, {frame: front_right_foot, type: point}, "
         "{frame: rear_left_foot, type: point}, {frame: rear_right_foot, type: point}]"],
        "contacts: without front_left_foot (flat) and with front_left_foot (point)",
    ),
    "base": (["robot.base_link=front_left_hip_link"], "robot.base_link: trunk; accepted: front_left_hip_link"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_factors_of_another_experiment_are_refused_by_name(
    fleet: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    overrides, expected = REFUSED[case]
    message = refusal(["identify", str(fleet / "experiment.yaml"), *overrides], fleet, capsys)
    assert message.startswith(f"torchid: {fleet}/factors/sway_test.factor: {expected}"), message


NEEDS_SAMPLES = {
    "sgd": ("estimator={name: sgd}", "estimator.name: sgd, but logs.train names factors"),
    "robust": ("estimator.robust=huber", "estimator.robust: set, but logs.train names factors"),
    "exclusion": (
        "preprocessing.exclude_condemned=true",
        "preprocessing.exclude_condemned: true, but logs.train",
    ),
    "noise": (
        "sensors.noise.joint_torque=0.2",
        "sensors.noise.joint_torque: 0.2, but 0.1 in {fleet}/factors/",
    ),
    "base noise": ("sensors.noise.base_force=[1,2,3]", "sensors.noise.base_force: 1, 2, 3, but 0.3, 0.3, 0.3 in"),
    "mixed": (
        "logs.train=[{fleet}/factors/sway_test.factor, {fleet}/sway_train.npz]",
        "logs.train: {fleet}/sway_train.npz beside factors of other logs; accepted: logs alone, or .factor files alone",
    ),
    "tests": ("logs.test=[{fleet}/factors/sway_test.factor]", "logs.test: {fleet}/factors/sway_test.factor, factors"),
}


@pytest.mark.parametrize("case", NEEDS_SAMPLES)
def test_what_needs_samples_or_other_noise_is_refused_by_name(
    fleet: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    override, expected = (text.replace("{fleet}", str(fleet)) for text in NEEDS_SAMPLES[case])
    message = refusal(["identify", str(fleet / "experiment.yaml"), override], fleet, capsys)
    assert expected in message, message


@pytest.mark.parametrize("command", ["analyze", "check", "compress"])
def test_commands_that_need_samples_say_so(fleet: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    options = ["--output", str(fleet / "out")] if command == "compress" else []
    message = refusal([command, str(fleet / "experiment.yaml"), *options], fleet, capsys)
    assert f"factors of a log, where torchid {command} needs its samples; accepted: logs (.npz, " in message


def test_factors_are_no_log(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "extension '.factor'" in refusal(["check", str(fleet / "factors" / "sway_test.factor")], fleet, capsys)


def test_files_of_different_noise_or_of_the_same_log_are_refused(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["compress", str(fleet / "logs.yaml"), "sensors.noise.joint_torque=0.2", "--output", str(tmp_path / "f")]
    assert main([*line, f"logs.train=[{fleet / 'sway_train.npz'}]"]) == 0
    capsys.readouterr()
    first, other = fleet / "factors" / "sway_test.factor", tmp_path / "f" / "sway_train.factor"
    experiment = ["identify", str(fleet / "experiment.yaml"), "sensors.noise.joint_torque=null"]
    message = refusal([*experiment, f"logs.train=[{first}, {other}]"], fleet, capsys)
    assert f"{other}: sensors.noise.joint_torque: 0.2; accepted: 0.1, as in {first}" in message
    again = tmp_path / "again.factor"
    again.write_bytes(first.read_bytes())
    message = refusal([*experiment, f"logs.train=[{first}, {again}]"], fleet, capsys)
    assert (
        f"{again}: sha256: of the same log as {first} (sway_test.npz); accepted: factors of every log once" in message
    )


def test_logs_of_one_name_are_not_compressed_to_one_file(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(fleet / "sway_test.npz", tmp_path / "sway_train.npz")
    logs = f"logs.train=[{fleet / 'sway_train.npz'}, {tmp_path / 'sway_train.npz'}]"
    line = ["compress", str(fleet / "logs.yaml"), logs, "--output", str(fleet / "out")]
    assert "several logs that would become sway_train.factor" in refusal(line, fleet, capsys)


def changed_urdf(fleet: Path, folder: Path, change: Callable[[str], str]) -> str:
    text = (fleet / "quadruped.urdf").read_text()
    assert change(text) != text
    (folder / "other.urdf").write_text(change(text))
    return f"robot.urdf={folder / 'other.urdf'}"


def test_another_tree_is_refused_by_the_part_that_differs(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    experiment = ["identify", str(fleet / "experiment.yaml")]

    def longer(text: str) -> str:
        joint = text.index('<joint name="front_left_knee"')
        return text[:joint] + re.sub(r'xyz="([^"]*) (\S+)"', r'xyz="\1 -0.31"', text[joint:], count=1)

    message = refusal([*experiment, changed_urdf(fleet, tmp_path, longer)], fleet, capsys)
    assert (
        "factors/sway_test.factor: robot.urdf: T_parent_joint of front_left_shank_link (revolute front_left_knee)"
        in message
    )
    renamed = changed_urdf(fleet, tmp_path, lambda text: text.replace('"front_left_thigh_link"', '"upper"'))
    assert "robot.urdf: without upper (revolute front_left_thigh) and with front_left_thigh_link" in refusal(
        [*experiment, renamed], fleet, capsys
    )

    def moved_foot(text: str) -> str:
        foot = text.index('<child link="front_left_foot"')
        joint = text.rindex("<joint", 0, foot)
        return text[:joint] + re.sub(r'xyz="([^"]*) (\S+)"', r'xyz="\1 -0.35"', text[joint:], count=1)

    message = refusal([*experiment, changed_urdf(fleet, tmp_path, moved_foot)], fleet, capsys)
    assert "robot.urdf: contact front_left_foot (point) is " in message


def test_robots_of_one_type_may_weigh_what_they_like(fleet: Path, tmp_path: Path) -> None:
    heavier = changed_urdf(
        fleet, tmp_path, lambda text: re.sub(r'<mass value="(\S+)"', r'<mass value="1\1"', text, count=1)
    )
    assert main(["identify", str(fleet / "experiment.yaml"), f"output={tmp_path / 'run'}", heavier]) == 0


# -------------------------------------------------------------------------------------------------------- hostile files


def rewritten(path: Path, target: Path, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> Path:
    """A file whose description and arrays are changed."""
    with np.load(path) as archive:
        arrays = dict(archive)
    description = json.loads(arrays["description"].tobytes())
    change(description, arrays)
    arrays["description"] = np.frombuffer(json.dumps(description).encode(), np.uint8)
    with target.open("wb") as stream:
        np.savez(stream, **arrays)
    return target


def first_part(description: dict[str, Any]) -> dict[str, Any]:
    part: dict[str, Any] = description["pieces"][0]
    return part


HOSTILE: dict[str, Callable[[dict[str, Any], dict[str, Any]], Any]] = {
    "a later format": lambda d, a: d.update(format=2),
    "no format": lambda d, a: d.pop("format"),
    "another key": lambda d, a: d.update(more=1),
    "no pieces": lambda d, a: d.update(pieces=[]),
    "no states": lambda d, a: d.update(by_state=[]),
    "samples": lambda d, a: d.update(samples=399),
    "a billion samples": lambda d, a: d.update(samples=10**15),
    "too many blocks": lambda d, a: d.update(blocks=1000),
    "a column that is none": lambda d, a: d["supports"][0].append(d["settings"]["columns"]),
    "a million columns": lambda d, a: d["settings"].update(columns=10**6),
    "columns as text": lambda d, a: d["settings"].update(columns="118"),
    "another state": lambda d, a: first_part(d).update(state="11"),
    "a state of letters": lambda d, a: first_part(d).update(state="abcd"),
    "another span": lambda d, a: first_part(d).update(samples=first_part(d)["samples"] + 1),
    "a piece twice": lambda d, a: d["pieces"].append(first_part(d)),
    "a state twice": lambda d, a: d["by_state"][0].update(state=d["by_state"][1]["state"]),
    "air that is no block": lambda d, a: d["unloaded"].append({"start": 1, "stop": 3, "parts": []}),
    "a triangle too many": lambda d, a: first_part(d)["triangles"].append([0, 1, False]),
    "a support that is none": lambda d, a: first_part(d)["triangles"].append([10**6, 1, False]),
    "more rows than a triangle has": lambda d, a: first_part(d)["triangles"][0].__setitem__(1, 10**6),
    "independent rows": lambda d, a: first_part(d).update(independent_rows=1e300),
    "a gated extra that is none": lambda d, a: first_part(d).update(gated=[0]),
    "negative samples": lambda d, a: first_part(d).update(samples=-1),
    "contacts as a number": lambda d, a: d["settings"].update(contacts=3.0),
    "contacts left out": lambda d, a: d["settings"].pop("contacts"),
    "no noise": lambda d, a: d["noise"].clear(),
    "negative noise": lambda d, a: d["noise"].update(joint_torque=-1.0),
    "a longer tree": lambda d, a: a.update(T_parent_joint=np.zeros((99, 4, 4))),
    "no tree": lambda d, a: a.pop("joint_map"),
    "NaN": lambda d, a: a["values"].__setitem__(5, np.nan),
    "infinity": lambda d, a: a["values"].__setitem__(5, np.inf),
    "numbers beyond all sense": lambda d, a: a["values"].__setitem__(5, 1e200),
    "fewer numbers": lambda d, a: a.update(values=a["values"][:-1]),
    "more numbers": lambda d, a: a.update(values=np.append(a["values"], 0.0)),
    "text for numbers": lambda d, a: a.update(values=np.array(["a", "b"])),
    "objects": lambda d, a: a.update(values=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_in_one_line(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    path = rewritten(fleet / "factors" / "sway_train.factor", tmp_path / "bad.factor", HOSTILE[case])
    message = refusal(["identify", str(fleet / "experiment.yaml"), f"logs.train=[{path}]"], fleet, capsys)
    assert message.startswith(f"torchid: {path}: "), message
    assert len(message) < 600
    if case == "a later format":
        assert f"{path}: format: 2, of another version of torchid; accepted: 1" in message


def test_damaged_files_give_a_fit_or_one_line(fleet: Path, tmp_path: Path) -> None:
    whole, rng = (fleet / "factors" / "sway_train.factor").read_bytes(), np.random.default_rng(3)
    path = tmp_path / "damaged.factor"

    def cases() -> Any:
        for number in range(150):
            kind, content = mutated(whole, rng)
            path.write_bytes(content)
            yield f"{kind} {number}", path

    tally = examined("damaged factors", cases(), read_factors, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.3, "or the files were hardly damaged"


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
        main_compress(fleet, tmp_path / "f")
    assert list(tmp_path.iterdir()) == []


def main_compress(fleet: Path, output: Path) -> None:
    compressed(fleet / "logs.yaml", output)


def test_only_factor_files_are_written_and_read(fleet: Path, tmp_path: Path) -> None:
    found: FactorFile = read_factors(fleet / "factors" / "sway_train.factor")
    with pytest.raises(torchid.TorchidError, match=r"extension '.npz'; accepted: .factor"):
        write_factors(tmp_path / "a.npz", replace(found))
    for name in ("missing.factor", "a.factor"):
        (tmp_path / "a.factor").mkdir(exist_ok=True)
        with pytest.raises(torchid.TorchidError, match="accepted: a whole .factor file"):
            read_factors(tmp_path / name)
