"""A user's mistake: exit status 2, one line on standard error, nothing written."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from demo import shortened_demo
from refusals import files_in, refusal
from repository import DEMO

from torchid.cli import main

Edit = Callable[[Path], None]


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the demo, shortened, that would run; also the working folder."""
    folder = shortened_demo(tmp_path / "experiment", 300)
    monkeypatch.chdir(folder)
    return folder


def edit_log(**changes: object) -> Edit:
    """Replace fields of the training log; None drops a field, a function maps the old value."""

    def apply(folder: Path) -> None:
        path = folder / "sway_train.npz"
        with np.load(path) as log:
            fields = dict(log)
        for name, change in changes.items():
            if change is None:
                del fields[name]
            else:
                fields[name] = change(fields[name]) if callable(change) else change
        np.savez(path, **fields)

    return apply


def edit_urdf(old: str, new: str) -> Edit:
    def apply(folder: Path) -> None:
        path = folder / "quadruped.urdf"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return apply


def edit_config(**changes: object) -> Edit:
    def apply(folder: Path) -> None:
        path = folder / "quadruped.yaml"
        settings = yaml.safe_load(path.read_text())
        for name, value in changes.items():
            settings[name] = value
        path.write_text(yaml.safe_dump(settings))

    return apply


def write(name: str, content: bytes) -> Edit:
    def apply(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)

    return apply


def both(first: Edit, second: Edit) -> Edit:
    def apply(folder: Path) -> None:
        first(folder)
        second(folder)

    return apply


def with_nan(sample: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(x: np.ndarray) -> np.ndarray:
        x = x.copy()
        x[sample, 3] = np.nan
        return x

    return change


def renamed(old: str, new: str) -> Callable[[np.ndarray], np.ndarray]:
    return lambda names: np.array([new if name == old else name for name in names])


LOOP = """<link name="extra"/><joint name="a" type="fixed"><parent link="trunk"/><child link="extra"/></joint>
<joint name="b" type="fixed"><parent link="front_left_foot"/><child link="extra"/></joint></robot>"""

LOGS: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "unknown joint": (
        edit_log(joint_names=renamed("rear_left_knee", "rear_left_kne")),
        ("rear_left_kne", "rear_left_knee"),
    ),
    "NaN in a measured torque": (edit_log(joint_torque=with_nan(7)), ("joint_torque",)),
    "torque missing": (edit_log(joint_torque=None), ("joint_torque", "missing")),
    "base position missing": (edit_log(base_position_world=None), ("base_linear_acceleration", "base_position_world")),
    "contact not in the URDF": (
        edit_log(contact_names=renamed("rear_left_foot", "rear_left_paw")),
        ("sway_train.npz: contact_names: unknown name 'rear_left_paw'", "rear_left_foot"),
    ),
    "pickled content": (
        edit_log(joint_names=np.array([f"{leg}_hip" for leg in "abcdefghijkl"], dtype=object)),
        ("joint_names", "pickle"),
    ),
    "not a log": (write("sway_train.npz", b"PK\x03\x04 truncated"), ("sway_train.npz",)),
}
ROBOTS: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "loop": (edit_urdf("</robot>", LOOP), ("extra", "one parent")),
    "mass missing": (edit_urdf('<mass value="11.0"/>', ""), ("trunk", "mass")),
    "malformed XML": (edit_urdf("</robot>", ""), ("quadruped.urdf", "well-formed")),
    "missing file": (lambda folder: (folder / "quadruped.urdf").unlink(), ("quadruped.urdf", "no such file")),
}

FILES: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "a number that YAML cannot make": (write("quadruped.yaml", b'device: !!int "x"'), ("quadruped.yaml", "YAML")),
    "YAML with a tag": (write("quadruped.yaml", b"robot: !!python/object/apply:os.getcwd []"), ("quadruped.yaml",)),
    "a log of another type": (both(write("a.wav", b"x"), edit_config(logs={"train": ["a.wav"]})), (".wav", ".npz")),
    "an output that is a file": (both(write("taken", b""), edit_config(output="taken")), ("taken", "output")),
    "an output with files": (both(write("full/mine", b"x"), edit_config(output="full")), ("full", "not empty")),
}  # fmt: skip

LIMB = "sensors={set: joints, ft_sensors: [%s]}"
SCALES = "sensors={set: joints, scales: {joint_torque: %s}}"
FEET = ", ".join(f"{{frame: {leg}_foot, type: point}}" for leg in ("front_left", "front_right", "rear_left"))
SETTINGS: list[tuple[str, ...]] = [
    ("preprocesing={cutoff_hz: 8}", "preprocesing", "preprocessing"),
    ("estimator={name: magic}", "estimator.name", "magic", "least_squares"),
    ("preprocessing={cutoff_hz: 80.0}", "cutoff_hz", "80"),
    ("sensors=everything", "sensors", "everything", "full"),
    ("sensors={joint_torques: [front_left_hop]}", "front_left_hop", "front_left_hip"),
    ("sensors={set: joints, noise: {joint_torque: 1.0e+300}}",
     "sensors.noise: standard deviations from 1e+300 to 1e+300; accepted: from 1e-9 to 1e6, the largest"),
    ("sensors={set: joints, noise: {joint_torque: {'*': 1.0e-9, front_left_hip: 0.1}}}",
     "sensors.noise: standard deviations from 1e-09 to 0.1; accepted: from 1e-9 to 1e6, the largest at most 1e7"),
    ("sensors={set: joints, offsets: {joint_torque: all, ft_force: log}}",
     "sensors.offsets.ft_force: no such sensor is measured; accepted: joint_torque, or"),
    ("sensors={set: contacts, scales: {joint_torque: all}}",
     "sensors.scales.joint_torque: no such sensor is measured; accepted: contact_force, or"),
    (SCALES % "['*_hip', ['*_knee', 'front_*_hip']]",
     "sensors.scales.joint_torque: 'front_left_hip' in two groups, [*_hip] and [*_knee, front_*_hip]; accepted:"),
    (SCALES % "['*_hp']", "sensors.scales.joint_torque: unknown name '*_hp'; accepted: "),
    ("sensors={joint_torques: [front_left_hip, front_left_knee], scales: {joint_torque: ['*_thigh']}}",
     "joint_torque: '*_thigh', its joint_torque is not measured; accepted: front_left_hip, front_left_knee"),
    (SCALES % "{hips: '*_hip'}",
     "sensors.scales.joint_torque: found {'hips': '*_hip'}; accepted: log, all, or a list of groups of joints"),
    (SCALES % "[[]]", "sensors.scales.joint_torque: found [[]]; accepted: log, all, or a list of groups"),
    ("sensors={set: joints, scales: {contact_force: ['*_foot']}}",
     "sensors.scales.contact_force: no such sensor is measured; accepted: joint_torque, or"),
    ("actuators={sign_width: 0.1}", "actuators.sign_width: set, but no joint torque is measured"),
    ("actuators={stribeck: auto}", "actuators.stribeck: set, but no joint torque is measured"),
    (LIMB % "front_left_hip",
     "sensors.ft_sensors: 'front_left_hip', a revolute joint, not a fixed joint; accepted: front_left_sole"),
    (LIMB % "front_left_foot",
     "sensors.ft_sensors: 'front_left_foot', a link, not a fixed joint; accepted: front_left_sole"),
    (LIMB % "front_left_sol", "sensors.ft_sensors: unknown name 'front_left_sol'; accepted: front_left_sole"),
    (LIMB % "front_left_sole", "sway_train.npz: ft_wrench: missing; accepted: the field"),
    ("sensors={contact_wrenches: {rear_left_foot: [mx]}}", "rear_left_foot", "mx", "fx"),
    ("contacts=[{frame: front_left_fot, type: point}]",
     "quadruped.yaml: contacts[0].frame: unknown name 'front_left_fot'; accepted: front_left_foot"),
    (f"contacts=[{FEET}]", "rear_right_foot", "active"),
    (f"contacts=[{FEET}, {{frame: rear_right_foot, type: point}}, {{frame: trunk, type: flat}}]", "trunk"),
    ("robot={urdf: quadruped.urdf, base_link: trnk}", "base_link", "trnk", "trunk"),
    ("logs={train: []}", "logs.train", "at least one"),
    ("logs={train: [nowhere.npz]}", "nowhere.npz"),
    ("sensors={joint_torques: [front_left_hip, front_left_thigh]}", "rank(S_b V_x)", "rank 0 of 6"),
    ("robot.fixed_base=true", "sensors", "they determine no parameter"),
    ("preprocessing={sample_rate_hz: 0.01}", "preprocessing.sample_rate_hz", "leaves one sample"),
    ("preprocessing={cutoff_hz: 8, sample_rate_hz: 15}", "preprocessing.sample_rate_hz", "16 Hz"),
    ("output=quadruped.urdf/run", "output", "cannot create a folder"),
    ("output=" + "x" * 300, "output", "accepted"),
    ("device=CPU", "device", "cuda:0"),
    ("device=cuda:77", "device", "cuda:77"),
]  # fmt: skip
OF_CONTACTS = ("actuators={sign", "actuators={stri", "robot.fixed_base")
"""Settings that are wrong where no joint torque is measured."""


@pytest.mark.parametrize(("change", "expected"), [*LOGS.values(), *ROBOTS.values(), *FILES.values()],
                         ids=[*LOGS, *ROBOTS, *FILES])  # fmt: skip
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_bad_input_exits_2_with_one_line_and_writes_nothing(
    experiment: Path, capsys: pytest.CaptureFixture[str], change: Edit, expected: tuple[str, ...]
) -> None:
    change(experiment)
    line = refusal(["identify", str(experiment / "quadruped.yaml")], experiment.parent, capsys)
    for part in expected:
        assert part in line


@pytest.mark.parametrize("case", SETTINGS, ids=lambda case: case[0][:60])
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_wrong_setting_exits_2_with_one_line_and_writes_nothing(
    experiment: Path, capsys: pytest.CaptureFixture[str], case: tuple[str, ...]
) -> None:
    setting, *expected = case
    key, _, value = setting.partition("=")
    if setting.startswith(OF_CONTACTS):
        edit_config(sensors="contacts")(experiment)
    if "." not in key:
        edit_config(**{key: yaml.safe_load(value)})(experiment)
    overrides = [setting] if "." in key else []
    line = refusal(["identify", str(experiment / "quadruped.yaml"), *overrides], experiment.parent, capsys)
    for part in expected:
        assert part in line


@pytest.mark.parametrize("command", ["identify", "analyze", "simulate"])
def test_a_log_in_place_of_an_experiment_file_is_told_for_what_it_is(
    experiment: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    line = refusal([command, str(experiment / "sway_train.npz")], experiment.parent, capsys)
    assert "sway_train.npz: file: a log, not a settings file" in line
    kind = "simulation" if command == "simulate" else "experiment"
    assert line.endswith(f"accepted: a YAML {kind} file")


@pytest.mark.parametrize("command", ["identify", "analyze", "simulate", "check"])
def test_a_command_without_arguments_asks_for_a_file_and_not_for_overrides(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    with pytest.raises(SystemExit):
        main([command])
    assert capsys.readouterr().err.endswith("the following arguments are required: file\n")


def test_unknown_override_names_the_nearest_key(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(experiment / "quadruped.yaml"), "estimator.rigde=1"]) == 2
    assert "accepted: ridge" in capsys.readouterr().err
    assert main(["identify", str(experiment / "quadruped.yaml"), "estimator.ridge"]) == 2
    assert "key.subkey=value" in capsys.readouterr().err


def test_an_interrupt_leaves_nothing_behind(
    experiment: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("json.dumps", interrupted)
    before = files_in(experiment.parent)
    assert main(["identify", str(experiment / "quadruped.yaml")]) == 1
    assert "interrupted; nothing was written" in capsys.readouterr().err
    assert files_in(experiment.parent) == before


def test_a_failure_that_is_no_bad_input_exits_1_without_a_traceback(
    experiment: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("json.dumps", full_disk)
    before = files_in(experiment.parent)
    assert main(["identify", str(experiment / "quadruped.yaml")]) == 1
    assert "No space left" in capsys.readouterr().err
    assert files_in(experiment.parent) == before


def test_a_limb_sensor_is_planned_at_a_fixed_joint_only(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    override = "analysis.candidates.ft_sensors=[front_left_knee]"
    line = refusal(["analyze", str(experiment / "quadruped.yaml"), override], experiment.parent, capsys)
    assert "analysis.candidates.ft_sensors: 'front_left_knee', a revolute joint, not a fixed joint" in line


@pytest.mark.parametrize("command", ["identify", "analyze", "simulate", "compress"])
def test_a_robot_in_place_of_an_experiment_file_is_told_for_what_it_is(
    experiment: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    urdf = experiment / "quadruped.urdf"
    short = experiment / "short.urdf"
    short.write_text('<robot name="r"><!-- mass: 1 kg --><link name="a"/></robot>')
    for path in (urdf, short):
        output = ["--output", str(experiment / "factors")] * (command == "compress")
        line = refusal([command, str(path), *output], experiment.parent, capsys)
        assert f"{path}: YAML: text, <" in line
        assert "accepted: a mapping with robot, " in line
        assert len(line) < 250


@pytest.mark.parametrize("override", ["contacts[0].type=flat", "contacts.0.type=flat", "sensors=[joints]"])
def test_an_override_that_does_not_fit_the_file_is_refused(
    experiment: Path, capsys: pytest.CaptureFixture[str], override: str
) -> None:
    assert main(["identify", str(experiment / "quadruped.yaml"), override]) == 2
    assert "accepted: " in capsys.readouterr().err


def test_evaluate_refuses_a_folder_that_is_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(tmp_path), "--log", "x.npz"]) == 2
    assert "config.yaml" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


URL_KEYS = ["logs.train=[s3://bucket/a.factor]", "logs.test=[memory://bucket/a.npz]", "robot.urdf=s3://bucket/a.urdf"]


@pytest.mark.parametrize("key", [*URL_KEYS, "output=s3://b/run"])
def test_no_key_takes_a_url(tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str) -> None:
    message = refusal(["identify", str(DEMO / "quadruped.yaml"), key], tmp_path, capsys)
    assert "is a URL (download it first); accepted: a path" in message


def test_compress_writes_to_no_url(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refusal(["compress", str(DEMO / "quadruped.yaml"), "--output", "s3://bucket/factors"], tmp_path, capsys)
    assert message.startswith("torchid: s3://bucket/factors: output: a URL; accepted: a local folder")
