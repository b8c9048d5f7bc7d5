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
from torchid.log_checks import SUSPICIOUS, Checked, Finding
from torchid.logs import Log, write_log

ARM = MACHINES["arm"]
JOINT = 3
NAME = "panda_joint4"


def of_joint(field: str, change: Callable[[np.ndarray], np.ndarray]) -> Log:
    log = case_of(ARM, "contacts").log
    values = value(getattr(log, field)).copy()
    values[:, JOINT] = change(values[:, JOINT])
    return replace(log, **{field: values})


def identified(
    log: Log, folder: Path, cutoff_hz: float = 10.0, noise: dict[str, float] | None = None
) -> torchid.Identification:
    write_log(log, folder / "arm.npz")
    return torchid.identify(
        robot={"urdf": str(ARM.urdf), "fixed_base": True},
        logs=[str(folder / "arm.npz")],
        preprocessing={"cutoff_hz": cutoff_hz},
        sensors={"set": "joints", "noise": noise or {}},
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
    assert any(f"joint_torque: {NAME}: the URDF fits best with a factor of" in one for one in answer(run).attention)


def of_random_torques() -> Log:
    log = case_of(ARM, "contacts").log
    return replace(log, joint_torque=10.0 * np.random.default_rng(0).normal(size=log.joint_position.shape))


def test_a_fit_that_leaves_most_of_the_forces_is_refused_whether_or_not_a_mistake_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = of_random_torques()
    with pytest.raises(
        ImplausibleFitError, match=r"the fit does not explain .* of the weighted forces; accepted: data and URDF"
    ):
        identified(log, tmp_path)
    band = Finding("dead band", SUSPICIOUS, "joint_torque", "reads 0", "switch the dead band off")
    late = Finding("delay", SUSPICIOUS, "joint_torque", "30 ms late", "shift them")
    for finding, named in ((band, "accepted: data and URDF"), (late, "joint_torque: 30 ms late; accepted: shift them")):
        of_all = Checked(log, log, (finding,), ())
        monkeypatch.setattr("torchid.commands.plausibility.check", lambda *_, found=of_all: found)
        with pytest.raises(ImplausibleFitError, match=named):
            identified(log, tmp_path)


def test_an_honest_log_is_not_suspected(tmp_path: Path) -> None:
    run = identified(case_of(ARM, "contacts").log, tmp_path)
    assert run.suspected == ""
