"""One motion of a simulation file, from the URDF to an exact recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchid.config import MotionConfig, SimulationConfig
from torchid.errors import InputError
from torchid.logs.fields import BoolArray
from torchid.simulation.controller import Controller
from torchid.simulation.feet import Foot, can_hold, find_feet
from torchid.simulation.motion import Motion
from torchid.simulation.plant import Plant
from torchid.simulation.recording import Recording, record
from torchid.simulation.stability import Stability, stability
from torchid.simulation.stance import Stance, find_stance


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
            InputError: it is too short, or lifts feet that the robot cannot do without.
        """
        frames = self.plant.foot_frames
        motion = Motion(config, self.stance, self.plant.joint_names, frames, self.config.control_hz, self.source)
        for support in motion.supports:
            self.check_support(support, f"motions.{config.name}.steps")
        return motion

    def check_support(self, support: BoolArray, field: str) -> None:
        """Refuse to stand on feet, (F,) bool, that cannot hold a robot.

        Raises:
            InputError: their contact points lie on a line.
        """
        standing = zip(self.feet, self.stance.feet, self.stance.rotations, support, strict=True)
        points = [middle + foot.arms @ R.T for foot, middle, R, on in standing if on]
        if not points or not can_hold(np.concatenate(points)):
            names = ", ".join(foot.frame for foot, on in zip(self.feet, support, strict=True) if on)
            found = f"stands on {names} alone, whose contact points lie on a line" if names else "no foot on the floor"
            raise InputError(self.source, field, found, "three points on the floor that do not, at any time")

    def run(self, config: MotionConfig, progress: Callable[[float], None] | None = None) -> tuple[Recording, Stability]:
        """Simulate a motion.

        Args:
            config: the motion.
            progress: called with the seconds simulated since the last call.

        Raises:
            InputError: the robot falls, slips, or its zero-moment point leaves the bounds.
        """
        friction = self.config.friction.levels or (0.0, 0.0)
        controller = Controller(self.plant, self.feet, self.stance.rotations, friction)
        recording = record(self.plant, controller, self.stance, self.motion(config), self.config, self.source, progress)
        found = stability(
            recording, self.plant, self.stance, self.feet, self.config.sensors.contact_threshold, self.source
        )
        found.check(self.config.bounds, config.name, self.source)
        return recording, found


def set_up_simulation(config: SimulationConfig, source: object = "simulation") -> Simulation:
    """Put the robot on its feet.

    Raises:
        InputError: the URDF, the feet or the posture are of no use.
    """
    feet = find_feet(config.feet, config.robot.urdf, source)
    plant = Plant(config.robot.urdf, feet, config.physics_hz, config.friction.levels)
    simulation = Simulation(config, source, plant, feet, find_stance(plant, feet, config.posture, source))
    simulation.check_support(np.ones(len(feet), dtype=bool), "feet")
    return simulation
