"""One motion of a simulation file, from the URDF to an exact recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torchid.config import FootConfig, MotionConfig, SimulationConfig
from torchid.errors import ConfigError
from torchid.simulation.controller import Controller
from torchid.simulation.motion import Motion
from torchid.simulation.plant import Foot, Plant, sphere_points
from torchid.simulation.recording import Recording, record
from torchid.simulation.stability import Stability, stability
from torchid.simulation.stance import Stance, find_stance

_DEFAULT_RADIUS = 0.01  # m, of contact points that the file gives


@dataclass(frozen=True)
class Simulation:
    """A robot on its feet, ready to move."""

    config: SimulationConfig
    source: object
    plant: Plant
    feet: tuple[Foot, ...]
    stance: Stance

    def motion(self, config: MotionConfig) -> Motion:
        """The goals of a motion.

        Raises:
            UnknownNameError: it moves what the robot does not have.
        """
        frames = self.plant.foot_frames
        return Motion(config, self.stance, self.plant.joint_names, frames, self.config.control_hz, self.source)

    def run(self, config: MotionConfig, progress: Callable[[float], None] | None = None) -> tuple[Recording, Stability]:
        """Simulate a motion.

        Args:
            config: the motion.
            progress: called with the seconds simulated since the last call.

        Raises:
            InputError: the robot falls, slips, or its zero-moment point leaves the bounds.
        """
        controller = Controller(self.plant, self.feet, self.stance.rotations)
        recording = record(self.plant, controller, self.stance, self.motion(config), self.config, self.source, progress)
        found = stability(recording, self.stance, self.feet, self.config.sensors.contact_threshold)
        found.check(self.config.bounds, config.name, self.source)
        return recording, found


def set_up_simulation(config: SimulationConfig, source: object = "simulation") -> Simulation:
    """Put the robot on its feet.

    Raises:
        InputError: the URDF, the feet or the posture are of no use.
    """
    feet = tuple(_foot(foot, config, source) for foot in config.feet)
    friction = (config.friction.coulomb, config.friction.viscous) if config.friction.enabled else None
    plant = Plant(config.robot.urdf, feet, config.physics_hz, friction)
    return Simulation(config, source, plant, feet, find_stance(plant, feet, config.posture, source))


def _foot(foot: FootConfig, config: SimulationConfig, source: object) -> Foot:
    if foot.points:
        return Foot(foot.frame, tuple((x, y, z) for x, y, z in foot.points), _DEFAULT_RADIUS)
    points, radius = sphere_points(config.robot.urdf, foot.frame)
    if not points:
        found = f"no points, and {config.robot.urdf.name} has no collision spheres at {foot.frame}"
        raise ConfigError(source, "feet", found, "points: [[x, y, z], ...] in the frame of the foot")
    return Foot(foot.frame, points, radius)
