"""A biped that steps tells offsets of its force sensors, different in every log, from its mass; one that squats not.

Sensors are off by 20 to 80 N and 2 to 8 N m along every axis: plates under the soles, or sensors in the ankles. Where
the acceleration of the base is noisy, too, readings in the air give the offsets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from motions import value
from recordings import Miscalibration
from simulated import BIPED, LIFTING, SOLES, feet_of
from synthetic import Array, load
from thinned import each_once
from unknowns import Fit, fit

from torchid import parameters
from torchid.estimators import LeastSquares
from torchid.identifiability.confounding import INFLATION_LIMIT, total_mass
from torchid.logs import Log, read_log
from torchid.logs.preprocess import preprocess
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import ExtraTerms, bind_log
from torchid.sensing import Contact, SensorNoise, named_sensors, with_ft_sensors

pytest.importorskip("mujoco", reason="the simulation needs mujoco, which the extra sim installs")

WELDS = ("l_sole_weld", "r_sole_weld")
CONTACTS = [Contact(frame, "flat") for frame in SOLES]
NOISE = SensorNoise(joint_torque=1.0, contact_force=5.0, contact_moment=0.5, base_force=12.0, base_moment=5.0)
STEPPING = ("sway_0.0hz", LIFTING, "sway_1.0hz")
CUTOFF_HZ = 10.0


@dataclass(frozen=True)
class Off:
    """A log with sensors that are off, and by how much, (C, 6) by the contacts."""

    log: Log
    offsets: Array


def spoilt(log: Log, mount: str, rng: np.random.Generator) -> Off:
    """As plates read along their own axes ("local") or the world's ("world"), or sensors in the ankles ("ankles")."""
    order = [log.contact_names.index(frame) for frame in SOLES]
    size = np.repeat([[20.0, 80.0], [2.0, 8.0]], 3, axis=0)
    offsets = rng.uniform(*size.T, (2, 6)) * rng.choice([-1.0, 1.0], (2, 6))
    wrench, n = value(log.contact_wrench_local)[:, order], len(log.joint_names)
    log = replace(log, contact_names=SOLES, contact_active=value(log.contact_active)[:, order])
    if mount == "world":
        R = feet_of(log)[1]
        wrench = (R[:, :, None] @ wrench.reshape(-1, 2, 2, 3, 1)).reshape(-1, 2, 6)
        log = replace(log, contact_wrench_local=None, contact_wrench_world=wrench)
    elif mount == "ankles":
        crossing = -np.where(value(log.contact_active)[..., None], wrench, 0.0)  # the soles have no mass
        log = replace(log, ft_names=WELDS, ft_wrench=crossing, contact_wrench_local=np.full_like(wrench, np.nan))
    else:
        log = replace(log, contact_wrench_local=wrench)
    one = np.ones((2, 6))
    sensors = Miscalibration(np.zeros(n), np.ones(n), offsets, one, offsets, one)
    return Off(sensors.read(log), offsets)


def identified(folder: Path, kind: str, names: tuple[str, ...], mount: str) -> tuple[Fit, list[Off]]:
    """A fit on plates or ankle sensors alone, from a URDF that is 20 % off; the logs are 1.7 to 4.1 s long."""
    welds, rng = WELDS if mount == "ankles" else (), np.random.default_rng(7)
    robot = load(folder / "nominal.urdf", None, False, welds)
    logs = [spoilt(read_log(folder / kind / f"{name}.npz"), mount, rng) for name in names]
    sensors = named_sensors("contacts", robot.n, 2, NOISE, len(welds))
    if welds:
        sensors = with_ft_sensors(replace(sensors, wrench=np.zeros((2, 6), dtype=bool)), robot, welds)
    channels = ("ft_force", "ft_moment") if welds else ("contact_force", "contact_moment")
    samples = [bind_log(preprocess(off.log, CUTOFF_HZ, 200.0), robot, CONTACTS) for off in logs]
    terms = ExtraTerms(offsets=dict.fromkeys(channels, "log"))
    return fit(robot, CONTACTS, sensors, terms, samples, LeastSquares(ridge=1e-4)), logs


def mass_error(found: Fit) -> float:
    """Of the total mass, relative."""
    true = load(BIPED).nominal[:, parameters.MASS].sum()
    return float(found.estimate.phi.reshape(-1, parameters.PER_BODY)[:, parameters.MASS].sum() / true - 1.0)


def force_errors(found: Fit, logs: list[Off]) -> Array:
    """Of all force offsets [N]."""
    errors = []
    for x in found.extras:
        if x.extra.component in WRENCH_COMPONENTS[:3]:
            (off,) = (off for off in logs if off.log.source == x.log)
            foot = [*SOLES, *WELDS].index(x.extra.name) % 2
            errors.append(x.value - off.offsets[foot, WRENCH_COMPONENTS.index(x.extra.component)])
    return np.array(errors)


@pytest.mark.parametrize(("mount", "kind"), each_once(["local", "world", "ankles"], ["exact", "logs"]))
def test_swing_phases_tell_offsets_from_mass(biped_folder: Path, mount: str, kind: str) -> None:
    mass, force = (2e-4, 0.1) if kind == "exact" else (5e-3, 1.0)
    found, logs = identified(biped_folder, kind, STEPPING, mount)
    errors = force_errors(found, logs)
    forces = [x for x in found.extras if x.extra.component in WRENCH_COMPONENTS[:3]]
    assert len(errors) == 2 * 3 * len(STEPPING)
    assert abs(mass_error(found)) < mass
    assert np.abs(errors).max() < force
    assert max(x.inflation for x in forces) < 0.5 * INFLATION_LIMIT
    assert total_mass(found.assembly, found.estimate).separable


SQUATTING = ("squat_0.5hz", "squat_1.0hz", "squat_2.0hz")


@pytest.mark.parametrize("kind", ["exact", "logs"])
@pytest.mark.parametrize("mount", ["local", "ankles"])
def test_feet_that_never_leave_the_ground_do_not_and_that_is_said_by_a_wide_margin(
    biped_folder: Path, mount: str, kind: str
) -> None:
    found, _ = identified(biped_folder, kind, SQUATTING, mount)
    vertical = [x for x in found.extras if x.extra.component == "fz"]
    assert len(vertical) == 2 * len(SQUATTING)
    assert min(x.inflation for x in vertical) > 30.0 * INFLATION_LIMIT
    assert not any(x.separable for x in found.extras)
    assert not total_mass(found.assembly, found.estimate).separable
    assert all(x.confounded_with for x in vertical)
