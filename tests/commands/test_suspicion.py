"""What `identify` says of an arm's log that is wrong in a way which masses, or the noise of a joint, make up for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mistaken import case_of
from motions import value
from walking import MACHINES

import torchid
from torchid.commands.answer import answer
from torchid.errors import ImplausibleFitError
from torchid.fitting.misfit import unexplained_joints
from torchid.logs import Log, write_log
from torchid.problem import Metrics

ARM = MACHINES["arm"]
JOINT = 3
NAME = "panda_joint4"


def of_joint(field: str, change: Callable[[np.ndarray], np.ndarray]) -> Log:
    log = case_of(ARM, "contacts").log
    values = value(getattr(log, field)).copy()
    values[:, JOINT] = change(values[:, JOINT])
    return replace(log, **{field: values})


def identified(log: Log, folder: Path) -> torchid.Identification:
    write_log(log, folder / "arm.npz")
    return torchid.identify(
        robot={"urdf": str(ARM.urdf), "fixed_base": True},
        logs=[str(folder / "arm.npz")],
        preprocessing={"cutoff_hz": 10},
        sensors="joints",
        estimator={"name": "least_squares", "ridge": 1e-4},
        output=None,
    )


@pytest.mark.parametrize(
    ("change", "named"),
    [(np.degrees, f"{NAME} in degrees"), (np.negative, f"{NAME} reversed")],
    ids=["degrees", "sign"],
)
def test_masses_that_make_up_for_a_wrong_position_are_refused_with_the_mistake(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], named: str
) -> None:
    with pytest.raises(ImplausibleFitError) as refused:
        identified(of_joint("joint_position", change), tmp_path)
    assert f"torchid check finds in arm.npz: joint_position: {named}" in str(refused.value)


def test_the_zero_of_an_encoder_is_named_beside_the_parameters(tmp_path: Path) -> None:
    run = identified(of_joint("joint_position", lambda q: q + 0.3), tmp_path)
    assert (
        answer(run).attention[0].startswith(f"torchid check finds in arm.npz: joint_position: {NAME}: positions read")
    )


def test_the_gear_of_one_joint_is_named_though_masses_make_up_for_a_part_of_it(tmp_path: Path) -> None:
    run = identified(of_joint("joint_torque", lambda torque: 2.0 * torque), tmp_path)
    assert any(f"joint_torque: {NAME}: factors that fit" in one for one in answer(run).attention)


def metrics_by_joint(left: float, floor: float | None) -> Metrics:
    """Of a shoulder of 40 N m that is explained, an elbow of 10 N m and a wrist of 0.5 N m, both in part."""
    measured, errors = {"shoulder": 40.0, "elbow": 10.0, "wrist": 0.5}, {"shoulder": 0.1, "elbow": left, "wrist": 0.4}
    shares = {name: errors[name] / measured[name] for name in measured}
    return Metrics({}, {}, {**errors}, {**shares}, None, noise={"joint_torque": floor})


def test_what_is_left_of_a_joint_s_torque_counts_beyond_noise_and_small_forces() -> None:
    assert unexplained_joints(metrics_by_joint(5.0, None)) == ["elbow"]
    assert unexplained_joints(metrics_by_joint(5.0, 1.0)) == ["elbow"]
    assert unexplained_joints(metrics_by_joint(5.0, 5.0)) == []
    assert unexplained_joints(metrics_by_joint(3.0, None)) == []


def test_an_honest_log_is_not_suspected(tmp_path: Path) -> None:
    run = identified(case_of(ARM, "contacts").log, tmp_path)
    assert run.suspected == ""
