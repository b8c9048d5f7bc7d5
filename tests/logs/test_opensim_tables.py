"""OpenSim's tables: lines up to endheader, tabs, and angles in degrees where the header says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import InputError
from torchid.logs import Columns, Log, read_log, write_log
from torchid.logs.blocks import log_bytes, open_log_blocks

TIME = np.arange(60) / 100.0
ANGLES = np.stack([30.0 * np.sin(3.0 * TIME), 20.0 * np.cos(2.0 * TIME)], axis=1)  # deg
SLIDE = 0.1 * np.sin(TIME)  # m
HEADER = "Coordinates\nversion=1\nnRows={rows}\nnColumns=5\ninDegrees={degrees}\n\nUnits are S.I. units.\n\nendheader\n"
MAP: dict[str, Any] = {
    "joint_position": {"columns": {"hip": "hip_r", "knee": "knee_r", "rail": "pelvis_tx"}},
    "joint_torque": {"columns": {"hip": "hip_r_moment", "knee": "hip_r_moment", "rail": "hip_r_moment"}},
}


def written(path: Path, degrees: str = "yes", end: str = "", header: str = HEADER) -> Path:
    """A table whose rows may end with a tab, as some programs write them."""
    names = ["time", "hip_r", "knee_r", "pelvis_tx"]
    rows = np.column_stack([TIME, ANGLES, SLIDE])
    lines = ["\t".join(f"{x!r}" for x in row.tolist()) + end for row in rows]
    path.write_text(header.format(rows=len(rows), degrees=degrees) + "\t".join(names) + "\n" + "\n".join(lines) + "\n")
    return path


def read(path: Path, **unit: Any) -> Log:
    return read_log(path, columns=Columns(joint_position=MAP["joint_position"] | unit))


@pytest.mark.parametrize("suffix", [".mot", ".sto", ".MOT"])
@pytest.mark.parametrize("end", ["", "\t", " \t"])
def test_degrees_of_the_header_are_those_of_what_turns(tmp_path: Path, suffix: str, end: str) -> None:
    log = read(written(tmp_path / f"x{suffix}", end=end))
    assert log.joint_names == ("hip", "knee", "rail")
    np.testing.assert_array_equal(log.time, TIME)
    np.testing.assert_allclose(log.joint_position[:, :2], np.radians(ANGLES), rtol=1e-15)
    np.testing.assert_array_equal(log.joint_position[:, 2], SLIDE)


def test_a_stated_unit_counts_before_the_header_and_radians_stay(tmp_path: Path) -> None:
    path = written(tmp_path / "x.mot")
    mixed = read(path, unit={"hip": "rad", "rail": "mm"})
    np.testing.assert_array_equal(mixed.joint_position[:, 0], ANGLES[:, 0])
    np.testing.assert_allclose(mixed.joint_position[:, 1], np.radians(ANGLES[:, 1]), rtol=1e-15)
    np.testing.assert_allclose(mixed.joint_position[:, 2], 1e-3 * SLIDE, rtol=1e-15)
    plain = read(written(tmp_path / "x.mot", degrees="no"))
    np.testing.assert_array_equal(plain.joint_position[:, :2], ANGLES)


def test_a_turn_of_such_angles_is_360_deg(tmp_path: Path) -> None:
    angles = ANGLES - 15.0
    turned = np.column_stack([TIME, np.mod(angles, 360.0), SLIDE])
    assert (np.abs(np.diff(turned[:, 1:3], axis=0)) > 300.0).any(axis=0).all()  # where a joint is straight
    rows = "".join("\t".join(map(repr, row)) + "\n" for row in turned.tolist())
    names = "time\thip_r\tknee_r\tpelvis_tx\n"
    (tmp_path / "x.mot").write_text(HEADER.format(rows=len(TIME), degrees="yes") + names + rows)
    log = read(tmp_path / "x.mot", turn_from={"hip": -180, "knee": -180})
    np.testing.assert_allclose(log.joint_position[:, :2], np.radians(angles), atol=1e-13)
    np.testing.assert_array_equal(log.joint_position[:, 2], SLIDE)


def test_blocks_and_ranges_are_those_of_the_whole_table(tmp_path: Path) -> None:
    path = written(tmp_path / "x.sto", end="\t")
    columns = Columns(joint_position=MAP["joint_position"])
    assert log_bytes(path, 1e9) >= 8 * 4 * len(TIME)
    whole = read(path)
    for folder in (None, tmp_path):
        with open_log_blocks(path, folder, columns) as blocks:
            part = blocks.read(slice(10, 30))
        np.testing.assert_array_equal(part.joint_position, whole.joint_position[10:30])
    part = read(tmp_path / "x.sto[0.1:0.2]")
    np.testing.assert_array_equal(part.joint_position, whole.joint_position[10:20])


def test_columns_of_the_log_format_are_read_without_a_map_but_not_in_degrees(tmp_path: Path) -> None:
    native = HEADER + "time\tjoint_position.a\n0\t1\n0.1\t2\n"
    (tmp_path / "x.sto").write_text(native.format(rows=2, degrees="no"))
    np.testing.assert_array_equal(read_log(tmp_path / "x.sto").joint_position, [[1.0], [2.0]])
    (tmp_path / "x.sto").write_text(native.format(rows=2, degrees="yes"))
    message = refused(lambda: read_log(tmp_path / "x.sto"), f"{tmp_path / 'x.sto'}: inDegrees: yes, though joint_pos")
    assert "logs.columns has entries for" in message


BROKEN = {
    "no end": ("a\nb\nc\n", "header: no line endheader"),
    "empty": ("", "header: no line endheader"),
    "nothing after it": ("version=1\nendheader\n", "header: an empty line"),
    "no rows": ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n", "time"),
    "a word": ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n0\t1\tx\t3\n1\t1\t1\t1\n", "column 'knee_r': 'x' in row 3"),
    "a cell too few": ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n0\t1\t2\n", "row 3: 3 cells; accepted: 4 cells"),
    "spaces": ("endheader\ntime hip_r knee_r\n0 1 2\n", "header: names between spaces"),
    "maybe": ("inDegrees=maybe\nendheader\ntime\thip_r\n0\t1\n", "inDegrees: 'maybe'"),
    "no text": ("endheader\n\x00\x01\t\x02\n0\t1\n", "header: "),
    "lines without end": ("x=1\n" * 5_000, "header: no line endheader"),
}


@pytest.mark.parametrize(("text", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_damaged_tables_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "x.mot"
    path.write_text(text)
    line = refused(lambda: read(path), f"{path}: ", InputError)
    assert message in line
    path.write_bytes(b"\xff\xfe" + text.encode("utf-16-le"))
    refused(lambda: read(path), f"{path}: ", InputError)


def test_nothing_is_written_to_such_files(tmp_path: Path) -> None:
    log = read(written(tmp_path / "x.mot"))
    message = refused(lambda: write_log(log, tmp_path / "y.mot"), f"{tmp_path / 'y.mot'}: file: extension '.mot'")
    assert message.endswith(".npz, .h5, .hdf5, .csv, .parquet")
    assert not (tmp_path / "y.mot").exists()


def test_init_says_that_angles_are_in_degrees_and_reads_them_so(tmp_path: Path) -> None:
    urdf = tmp_path / "leg.urdf"
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    link = f'<link name="{{}}"><inertial><mass value="1"/>{inertia}</inertial></link>'
    joint = (
        '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/>'
        '<limit lower="-2" upper="2" effort="9" velocity="9"/></joint>'
    )
    parts = [link.format(name) for name in ("base", "thigh", "shank")]
    parts += [joint.format("hip", "base", "thigh"), joint.format("knee", "thigh", "shank")]
    urdf.write_text(f'<robot name="leg">{"".join(parts)}</robot>')
    lines = ["\t".join(map(repr, [t, *a, 0.1 * t, 0.2])) for t, a in zip(TIME.tolist(), ANGLES.tolist(), strict=True)]
    names = "time\tangle_hip\tangle_knee\tmoment_hip\tmoment_knee\n"
    (tmp_path / "x.mot").write_text(HEADER.format(rows=60, degrees="yes") + names + "\n".join(lines) + "\n")
    said = init(urdf, tmp_path / "x.mot", tmp_path / "x.yaml")
    assert "joint_position: deg, as the file's header says (inDegrees=yes)" in said.assumed
    config = load_config(tmp_path / "x.yaml")
    log = read_log(tmp_path / "x.mot", columns=config.logs.columns)
    np.testing.assert_allclose(log.joint_position, np.radians(ANGLES), rtol=1e-15)
