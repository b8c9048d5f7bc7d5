"""Five recordings in five dialects are the same log, read whole or in blocks, each by a map of at most 15 lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dialects import DIALECTS, ORDER, parsed_map, with_velocity
from repository import DEMO

from torchid.logs import Log, read_log
from torchid.logs.blocks import open_log_blocks

each = pytest.mark.parametrize("dialect", DIALECTS)


@pytest.fixture(scope="module")
def recorded() -> Log:
    return with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 150)))


@each
def test_a_dialect_is_the_log_it_was_written_from(tmp_path: Path, recorded: Log, dialect: str) -> None:
    name, text, write = DIALECTS[dialect]
    log = read_log(write(tmp_path / name, recorded), columns=parsed_map(text))
    assert set(log.joint_names) == set(ORDER)
    joints = [recorded.joint_names.index(joint) for joint in log.joint_names]
    contacts = [recorded.contact_names.index(contact) for contact in log.contact_names]
    assert len(log) == len(recorded)
    assert {"joint_position", "joint_velocity", "joint_torque", "contact_active"} < set(log.arrays())
    for field, values in log.arrays().items():
        expected = recorded.arrays()[field]
        order = joints if field.startswith("joint_") else contacts if field.startswith("contact_") else slice(None)
        expected = expected if field == "time" else expected[:, order]
        np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12, err_msg=field)


@each
def test_blocks_of_a_dialect_are_its_samples_to_the_bit(tmp_path: Path, recorded: Log, dialect: str) -> None:
    name, text, write = DIALECTS[dialect]
    path, columns = write(tmp_path / name, recorded), parsed_map(text)
    whole = read_log(path, columns=columns)
    with open_log_blocks(path, tmp_path, columns) as blocks:
        assert len(blocks) == len(whole)
        for samples in (slice(0, 40), slice(40, 41), slice(41, 150)):
            part, expected = blocks.read(samples), whole.select(samples)
            assert (part.names, part.imu_frame) == (whole.names, whole.imu_frame)
            assert part.arrays().keys() == expected.arrays().keys()
            for field, values in expected.arrays().items():
                np.testing.assert_array_equal(part.arrays()[field], values, err_msg=field)


@each
def test_a_part_of_a_dialect_is_cut_in_its_seconds(tmp_path: Path, recorded: Log, dialect: str) -> None:
    name, text, write = DIALECTS[dialect]
    path, columns = write(tmp_path / name, recorded), parsed_map(text)
    whole, part = read_log(path, columns=columns), read_log(f"{path}[0.5:]", columns=columns)
    kept = int(np.searchsorted(whole.time, whole.time[0] + 0.5 - 1e-6))
    assert 0 < kept < len(whole)
    np.testing.assert_array_equal(part.joint_torque, whole.select(slice(kept, None)).joint_torque)
