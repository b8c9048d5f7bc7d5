"""The settings file of `torchid simulate`: a robot, its feet, motions, and its sensors' imperfections."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.config.robot import ConstrainedRobot, require_one_file
from torchid.config.settings_files import FileKind, load
from torchid.errors import ConfigError, about_file
from torchid.settings import STRICT, BelowOne, FileName, NotNegative, Number, Positive, Seed

Point = Annotated[list[Number], Field(min_length=3, max_length=3)]


@dataclass(config=STRICT, frozen=True)
class SimulatedRobotConfig(ConstrainedRobot):
    """The true robot, `urdf` or `mjcf`. Its base is the URDF's root, or the body with the free joint."""


@dataclass(config=STRICT, frozen=True)
class FootConfig:
    """A foot: its URDF `frame`, and its contact `points` [m], by default the collision spheres of its link.

    `sensor`: wrench: the whole wrench; fn: the force along the floor's normal.
    """

    frame: str
    points: list[Point] = dataclasses.field(default_factory=list)
    sensor: Literal["wrench", "fn"] = "wrench"


@dataclass(config=STRICT, frozen=True)
class WaveConfig:
    """A sine: `what` is com_x, com_y, com_z [m], base_roll, base_pitch, base_yaw [rad] or a joint [rad or m].

    `amplitude` has its unit, `phase` is in turns.
    """

    what: str
    hz: Positive
    amplitude: Number
    phase: Number = 0.0


@dataclass(config=STRICT, frozen=True)
class StepsConfig:
    """Feet are lifted in turn: foot i of k in `order` is highest at (i + 1/2)/k of every period 1/hz.

    `swing_s`: time in the air. `transfer_s`: time in which the load leaves the foot, and in which it returns.
    """

    hz: Positive
    order: Annotated[list[str], Field(min_length=1)]
    height_m: Positive = 0.05
    swing_s: Positive = 1.4
    transfer_s: Positive = 0.25


@dataclass(config=STRICT, frozen=True)
class MotionConfig:
    """One log: waves about the stance, and steps. `name` is the name of its file, `duration_s` its length [s]."""

    name: FileName
    duration_s: Annotated[Positive, Field(le=3600.0)]
    waves: list[WaveConfig] = dataclasses.field(default_factory=list)
    steps: StepsConfig | None = None


@dataclass(config=STRICT, frozen=True)
class WhiteNoiseConfig:
    """White noise of every sample: standard deviations [rad or m, m, rad, N m or N, N, N m]."""

    enabled: bool = False
    joint_position: NotNegative = 1e-4
    base_position: NotNegative = 1e-4
    base_orientation: NotNegative = 1e-4
    joint_torque: NotNegative = 1.0
    contact_force: NotNegative = 5.0
    contact_moment: NotNegative = 0.5


@dataclass(config=STRICT, frozen=True)
class BiasConfig:
    """Constant errors of every force channel, the same in all logs: standard deviations [N m, N, N m, 1]."""

    enabled: bool = False
    joint_torque: NotNegative = 1.0
    contact_force: NotNegative = 10.0
    contact_moment: NotNegative = 1.0
    gain: NotNegative = 0.02


@dataclass(config=STRICT, frozen=True)
class DelayConfig:
    """Delay of the foot sensors, `feet_s` [s]."""

    enabled: bool = False
    feet_s: NotNegative = 0.01


@dataclass(config=STRICT, frozen=True)
class FrictionConfig:
    """Friction of every joint [N m, N m s/rad]. If not enabled: the URDF's."""

    enabled: bool = False
    coulomb: NotNegative = 1.0
    viscous: NotNegative = 0.5

    @property
    def levels(self) -> tuple[float, float] | None:
        """Coulomb and viscous friction, None when off."""
        return (self.coulomb, self.viscous) if self.enabled else None


@dataclass(config=STRICT, frozen=True)
class SensorImperfectionsConfig:
    """Errors of the sensors. A contact is active while its measured load exceeds `contact_threshold` [N]."""

    noise: WhiteNoiseConfig = dataclasses.field(default_factory=WhiteNoiseConfig)
    bias: BiasConfig = dataclasses.field(default_factory=BiasConfig)
    delay: DelayConfig = dataclasses.field(default_factory=DelayConfig)
    contact_threshold: Positive = 30.0


@dataclass(config=STRICT, frozen=True)
class BoundsConfig:
    """Limits of a motion [m]: change of base height, slip of a foot, position of the zero-moment point.

    `zmp_m`: smallest distance from the zero-moment point to the border of the support polygon.
    """

    height_m: Positive = 0.2
    slip_m: Positive = 0.01
    zmp_m: Number = 0.005


@dataclass(config=STRICT, frozen=True)
class NominalConfig:
    """The nominal robot. `error`: error of mass, centre of mass and inertia of each body, as a share."""

    error: BelowOne = 0.2
    seed: Seed = 0


@dataclass(config=STRICT, frozen=True, kw_only=True)
class SimulationConfig:
    """One simulation: every motion becomes a log."""

    robot: SimulatedRobotConfig
    feet: Annotated[list[FootConfig], Field(min_length=1)]
    motions: Annotated[list[MotionConfig], Field(min_length=1)]
    output: Path
    posture: dict[str, Number] = dataclasses.field(default_factory=dict)
    friction: FrictionConfig = dataclasses.field(default_factory=FrictionConfig)
    sensors: SensorImperfectionsConfig = dataclasses.field(default_factory=SensorImperfectionsConfig)
    nominal: NominalConfig = dataclasses.field(default_factory=NominalConfig)
    bounds: BoundsConfig = dataclasses.field(default_factory=BoundsConfig)
    physics_hz: Positive = 1000.0
    control_hz: Positive = 500.0
    seed: Seed = 0
    overwrite: bool = False


_FILE = FileKind(
    SimulationConfig,
    "simulation",
    "robot, feet, motions, output",
    "feet=[{frame: l_sole}, {frame: r_sole}]",
    ("robot.urdf", "robot.mjcf"),
    ("output",),
)


def load_simulation(path: str | Path, overrides: Sequence[str] = ()) -> SimulationConfig:
    """Read and check a simulation file.

    Args:
        path: the YAML file; paths in it are relative to it, but `output` to the working directory.
        overrides: `key.subkey=value`, the value in YAML; paths in them are relative to the working directory.

    Raises:
        ConfigError: unreadable file, a value of the wrong kind, a missing key, rates or names that do not go together.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    path = Path(path)
    config = load(_FILE, path, overrides)
    with about_file(path):
        require_one_file(config.robot)
    ratio = config.physics_hz / config.control_hz
    if abs(ratio - max(round(ratio), 1)) > 1e-9:
        raise ConfigError(path, "control_hz", f"{config.control_hz:g}", f"{config.physics_hz:g} / a whole number")
    names = [motion.name for motion in config.motions]
    again = [name for name in names if names.count(name) > 1]
    if again:
        raise ConfigError(path, "motions", f"several named '{again[0]}'", "different names")
    return config
