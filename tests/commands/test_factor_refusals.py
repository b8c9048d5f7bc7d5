"""Factors that do not belong together, damaged and hostile ones: one line with what was found and what is accepted."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fleets import demo_fleet
from hostile import examined
from hostile_logs import mutated
from refusals import refusal

from torchid.cli import main
from torchid.fitting.factor_files import FORMAT, read_factors

pytestmark = [
    pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.NumericalWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.ConfoundedWarning"),
    pytest.mark.filterwarnings("ignore:.*in the air:torchid.errors.TorchidWarning"),
]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_fleet(tmp_path_factory.mktemp("fleet") / "demo")


# ------------------------------------------------------------------------------------------------------------- refusals

REFUSED = {
    "sensors": (["sensors.set=full"], "sensors: lacks front_left_foot fx"),
    "other sensors": (["sensors.set=contacts", "sensors.on_base_lost=warn"], "sensors: lacks front_left_foot fx"),
    "filter": (["preprocessing.cutoff_hz=9"], "preprocessing.cutoff_hz: 8; accepted: 9, as in the experiment file"),
    "no filter": (["preprocessing.cutoff_hz=null"], "preprocessing.cutoff_hz: 8; accepted: none"),
    "margin": (["preprocessing.contact_margin_s=0.1"], "preprocessing.contact_margin_s: none; accepted: 0.1"),
    "extras": (["sensors.offsets=log"], "sensors.offsets: lacks offset of front_left_hip, by log"),
    "scales": (["sensors.scales=all"], "sensors.scales: lacks scale of front_left_hip, of all logs"),
    "actuators": (["actuators.armature=true"], "actuators: lacks armature of front_left_hip"),
    "tilt": (["robot.base_tilt=[0.1, 0]"], "robot.base_tilt: none; accepted: 0.1, 0.0, as in the experiment file"),
    "sign": (["actuators.sign_width=0.1"], "actuators.sign_width: none; accepted: 0.1"),
    "delay": (["actuators.delay=0.003"], "actuators.delay: none; accepted: 0.003, as in the experiment file"),
    "contacts": (
        ["contacts=[{frame: front_left_foot, type: point}, {frame: front_right_foot, type: point}]"],
        "contacts: has also rear_left_foot (point), rear_right_foot (point)",
    ),
    "contact type": (
        ["contacts=[{frame: front_left_foot, type: flat}, {frame: front_right_foot, type: point}, "
         "{frame: rear_left_foot, type: point}, {frame: rear_right_foot, type: point}]"],
        "contacts: lacks front_left_foot (flat) and has also front_left_foot (point)",
    ),
    "radius": (
        ["contacts=[{frame: front_left_foot, type: point, radius: 0.02}, {frame: front_right_foot, type: point}, "
         "{frame: rear_left_foot, type: point}, {frame: rear_right_foot, type: point}]"],
        "contacts: lacks front_left_foot (point, radius 0.02 m, normal 0.0, 0.0, 1.0) and has also front_left_foot (po",
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
    "sgd": ("estimator={name: sgd}", "estimator.name: sgd, but logs.train has factors"),
    "robust": ("estimator.robust=huber", "estimator.robust: set, but logs.train has factors"),
    "exclusion": (
        "preprocessing.exclude_rejected=true",
        "preprocessing.exclude_rejected: true, but logs.train",
    ),
    "noise": (
        "sensors.noise.joint_torque=0.2",
        "sensors.noise.joint_torque.front_left_hip: 0.2, but 0.1 in {fleet}/factors/",
    ),
    "noise of a joint": (
        "sensors.noise.joint_torque={'*': 0.1, '*_left_knee': 0.3}",
        "sensors.noise.joint_torque.front_left_knee: 0.3, but 0.1 in {fleet}/factors/",
    ),
    "base noise": ("sensors.noise.base_force=[1,2,3]", "sensors.noise.base_force.x: 1, but 0.3 in {fleet}/factors/"),
    "mixed": (
        "logs.train=[{fleet}/factors/sway_test.factor, {fleet}/sway_train.npz]",
        "logs.train: {fleet}/sway_train.npz is a log, but other entries are factors; accepted: only logs, or only ",
    ),
    "tests": (
        "logs.test=[{fleet}/factors/sway_test.factor]",
        "logs.test: {fleet}/factors/sway_test.factor has factors",
    ),
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
    assert f"has factors, but torchid {command} needs samples; accepted: logs (.npz, " in message


def test_files_of_different_noise_or_of_the_same_log_are_refused(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["compress", str(fleet / "logs.yaml"), "sensors.noise.joint_torque=0.2", "--output", str(tmp_path / "f")]
    assert main([*line, f"logs.train=[{fleet / 'sway_train.npz'}]"]) == 0
    capsys.readouterr()
    first, other = fleet / "factors" / "sway_test.factor", tmp_path / "f" / "sway_train.factor"
    experiment = ["identify", str(fleet / "experiment.yaml"), "sensors.noise.joint_torque=null"]
    message = refusal([*experiment, f"logs.train=[{first}, {other}]"], fleet, capsys)
    assert f"{other}: sensors.noise.joint_torque.front_left_hip: 0.2; accepted: 0.1, as in {first}" in message
    again = tmp_path / "again.factor"
    again.write_bytes(first.read_bytes())
    message = refusal([*experiment, f"logs.train=[{first}, {again}]"], fleet, capsys)
    assert f"{again}: sha256: same log as {first} (sway_test.npz); accepted: each log once" in message


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
    assert "robot.urdf: lacks upper (revolute front_left_thigh) and has also front_left_thigh_link" in refusal(
        [*experiment, renamed], fleet, capsys
    )

    def moved_foot(text: str) -> str:
        foot = text.index('<child link="front_left_foot"')
        joint = text.rindex("<joint", 0, foot)
        return text[:joint] + re.sub(r'xyz="([^"]*) (\S+)"', r'xyz="\1 -0.35"', text[joint:], count=1)

    message = refusal([*experiment, changed_urdf(fleet, tmp_path, moved_foot)], fleet, capsys)
    assert "robot.urdf: contact front_left_foot (point) differs by " in message


# -------------------------------------------------------------------------------------------------------- hostile files


def first_part(description: dict[str, Any]) -> dict[str, Any]:
    part: dict[str, Any] = description["pieces"][0]
    return part


ONE_NOISE = "one noise of all joints, as once"
HOSTILE: dict[str, Callable[[dict[str, Any], dict[str, Any]], Any]] = {
    "a later format": lambda d, a: d.update(format=FORMAT + 1),
    "no pieces": lambda d, a: d.update(pieces=[]),
    "no states": lambda d, a: d.update(by_state=[]),
    "samples": lambda d, a: d.update(samples=199),
    "a billion samples": lambda d, a: d.update(samples=10**15),
    "too many blocks": lambda d, a: d.update(blocks=1000),
    "a column that is none": lambda d, a: d["supports"][0].append(d["settings"]["columns"]),
    "another state": lambda d, a: first_part(d).update(state="11"),
    "another span": lambda d, a: first_part(d).update(samples=first_part(d)["samples"] + 1),
    "a state twice": lambda d, a: d["by_state"][0].update(state=d["by_state"][1]["state"]),
    "air that is no block": lambda d, a: d["unloaded"].append([1, 3, []]),
    "a triangle too many": lambda d, a: first_part(d)["blocks"].append([0, 1]),
    "more rows than a triangle has": lambda d, a: first_part(d)["blocks"][0].__setitem__(1, 10**6),
    "independent rows": lambda d, a: first_part(d).update(independent_rows=1e300),
    "contacts as a number": lambda d, a: d["settings"].update(contacts=3.0),
    "negative noise": lambda d, a: d["noise"].update({"joint_torque.front_left_hip": -1.0}),
    "noise of nothing": lambda d, a: d["noise"].update({"base_force.x": 1e-300}),
    "noise far from the others": lambda d, a: d["noise"].update({"base_force.x": 1e6, "base_force.y": 1e-6}),
    ONE_NOISE: lambda d, a: d.update(
        noise={"joint_torque": 0.1} | {name: x for name, x in d["noise"].items() if "joint_torque" not in name}
    ),
    "a longer tree": lambda d, a: a.update(T_parent_joint=np.zeros((99, 4, 4))),
    "no tree": lambda d, a: a.pop("joint_map"),
    "NaN": lambda d, a: a["values"].__setitem__(5, np.nan),
    "numbers beyond all sense": lambda d, a: a["values"].__setitem__(5, 1e200),
    "fewer numbers": lambda d, a: a.update(values=a["values"][:-1]),
    "more numbers": lambda d, a: a.update(values=np.append(a["values"], 0.0)),
    "text for numbers": lambda d, a: a.update(values=np.array(["a", "b"])),
}


def test_damaged_files_give_a_fit_or_one_line(fleet: Path, tmp_path: Path) -> None:
    whole, rng = (fleet / "factors" / "sway_train.factor").read_bytes(), np.random.default_rng(3)
    path = tmp_path / "damaged.factor"

    def cases() -> Any:
        for number in range(80):
            kind, content = mutated(whole, rng)
            path.write_bytes(content)
            yield f"{kind} {number}", path

    tally = examined("damaged factors", cases(), read_factors, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.3, "or the files were hardly damaged"


def test_logs_of_one_name_are_not_compressed_to_one_file(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(fleet / "sway_test.npz", tmp_path / "sway_train.npz")
    logs = f"logs.train=[{fleet / 'sway_train.npz'}, {tmp_path / 'sway_train.npz'}]"
    line = ["compress", str(fleet / "logs.yaml"), logs, "--output", str(fleet / "out")]
    assert "several logs have the file name sway_train.factor" in refusal(line, fleet, capsys)


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


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_in_one_line(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    path = rewritten(fleet / "factors" / "sway_train.factor", tmp_path / "bad.factor", HOSTILE[case])
    message = refusal(["identify", str(fleet / "experiment.yaml"), f"logs.train=[{path}]"], fleet, capsys)
    assert message.startswith(f"torchid: {path}: "), message
    assert len(message) < 600
    if case == "a later format":
        assert f"{path}: format: {FORMAT + 1}, of another version of torchid; accepted: {FORMAT}" in message
    if case == ONE_NOISE:
        assert f"{path}: sensors.noise: joint_torque, base_force.x" in message
        assert "accepted: joint_torque.front_left_hip" in message
