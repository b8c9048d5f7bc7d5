"""A biped that steps tells offsets of its force sensors, different in every log, from its mass; one that squats not.

Sensors are off by 20 to 80 N and 2 to 8 N m along every axis: plates under the soles, or sensors in the ankles. Where
the acceleration of the base is noisy, too, readings in the air give the offsets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from motions import value
from recordings import Miscalibration
from simulated import BIPED, LIFTING, SOLES, feet_of
from synthetic import Array, load
from thinned import each_once
from unknowns import Fit, fit

from torchid import parameters
from torchid.cli import main
from torchid.estimators import LeastSquares
from torchid.identifiability.confounding import INFLATION_LIMIT, total_mass
from torchid.logs import Log, read_log, write_log
from torchid.logs.preprocess import preprocess
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import ExtraTerms, Samples, bind_log
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, named_sensors, with_ft_sensors

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


# --------------------------------------------------------------------------- noise in the acceleration of the base

OFF = np.array([[-30.0, 0.0, 60.0, 0.0, 0.0, 0.0], [0.0, 0.0, 60.0, 0.0, 4.0, 0.0]])  # of both soles [N, N m]
ACCELERATION, YAW = 1.0, 2.3  # noise at 1 kHz [m/s^2, rad/s^2]: of one size in forces along all axes, and in moments
WHITE = np.array([2.0] * 3 + [0.2] * 3)  # noise of the contact sensors at 1 kHz [N, N m]


@dataclass(frozen=True)
class Gait:
    """Two recordings of a gait in which each foot swings once, with its noise."""

    robot: Robot
    exact: Log
    cutoff_hz: float | None

    @classmethod
    def of(cls, folder: Path, cutoff_hz: float | None) -> Gait:
        log = read_log(folder / "exact" / f"{LIFTING}.npz")
        order = [log.contact_names.index(frame) for frame in SOLES]
        active, wrench = value(log.contact_active)[:, order], value(log.contact_wrench_local)[:, order]
        log = replace(log, contact_names=SOLES, contact_active=active, contact_wrench_local=wrench)
        if cutoff_hz is None:
            log = log.select(slice(None, None, 5))
        return cls(load(folder / "nominal.urdf"), log, cutoff_hz)

    @property
    def noise_left(self) -> float:
        """Share of the noise that the filter lets pass; without one, less is put in for it."""
        return 0.13 if self.cutoff_hz else 0.2

    @property
    def sensors(self) -> SensorSet:
        """With the noise that there is in the rows."""
        force, moment = 65.9 * ACCELERATION * self.noise_left, 3.3 * ACCELERATION * self.noise_left
        noise = SensorNoise(1.0, 2.0 * self.noise_left, 0.2 * self.noise_left, force, moment)
        return named_sensors("contacts", self.robot.n, 2, noise)

    def recorded(self, rng: np.random.Generator, off: Array = OFF) -> list[Log]:
        return [self._recorded(rng, name, off) for name in ("a.npz", "b.npz")]

    def _recorded(self, rng: np.random.Generator, name: str, off: Array) -> Log:
        size, exact = 1.0 if self.cutoff_hz else self.noise_left, self.exact

        def noisy(x: Array | None, deviation: Array | float) -> Array:
            return value(x) + size * deviation * rng.normal(size=value(x).shape)

        return replace(
            exact,
            source=name,
            contact_wrench_local=noisy(exact.contact_wrench_local, WHITE) + off,
            base_linear_acceleration_world=noisy(exact.base_linear_acceleration_world, ACCELERATION),
            base_angular_acceleration_base=noisy(exact.base_angular_acceleration_base, np.array([0.0, 0.0, YAW])),
        )

    def samples(self, logs: list[Log], in_the_air: bool = True) -> list[Samples]:
        """Without the readings in the air, if so said."""
        rate = 200.0 if self.cutoff_hz else None
        found = [bind_log(preprocess(log, self.cutoff_hz, rate), self.robot, CONTACTS) for log in logs]
        return found if in_the_air else [replace(samples, unloaded=None) for samples in found]

    def fit(self, samples: list[Samples]) -> Fit:
        terms = ExtraTerms(offsets={"contact_force": "log", "contact_moment": "log"})
        return fit(self.robot, CONTACTS, self.sensors, terms, samples, LeastSquares(ridge=1e-6))


def test_the_command_names_sensors_that_read_another_offset_in_the_air_or_nothing(
    biped_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gait, rng = Gait.of(biped_folder, 10.0), np.random.default_rng(1)
    sound, wrong = gait.recorded(rng)
    wrench, lifted = value(wrong.contact_wrench_local).copy(), ~value(wrong.contact_active)
    wrench[lifted[:, 0], 0, 2] += 45.0
    wrench[lifted[:, 1], 1] = 0.0
    write_log(sound, tmp_path / "sound.npz")
    write_log(replace(wrong, contact_wrench_local=wrench), tmp_path / "wrong.npz")
    noise = {name: float(x) for name, x in vars(gait.sensors.noise).items() if x is not None}
    experiment = {
        "robot": {"urdf": str(biped_folder / "nominal.urdf")},
        "contacts": [{"frame": frame, "type": "flat"} for frame in SOLES],
        "logs": {"train": ["sound.npz", "wrong.npz"], "test": []},
        "preprocessing": {"cutoff_hz": 10.0, "sample_rate_hz": 200.0},
        "sensors": {"set": "contacts", "offsets": {"contact_force": "log", "contact_moment": "log"}, "noise": noise},
        "estimator": {"name": "least_squares", "ridge": 1e-6},
        "output": str(tmp_path / "run"),
    }
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(experiment))
    assert main(["identify", str(tmp_path / "experiment.yaml")]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "in the air" in line]
    assert len(said) == 2
    zeros, contradiction = sorted(said, key=lambda line: "exactly 0" not in line)
    assert "wrong.npz: fx, fy, fz, mx, my, mz of r_sole read exactly 0 in the air" in zeros
    assert "wrong.npz: l_sole fz reads 105" in contradiction
    assert "r_sole" not in contradiction
