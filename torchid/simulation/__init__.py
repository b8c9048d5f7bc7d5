"""Simulated robots on a floor: reference motions, exact recordings, and logs of imperfect sensors."""

from torchid.simulation.motion import LEAD_S
from torchid.simulation.sensors import sensor_log
from torchid.simulation.simulation import Recording, Simulation, Stability, set_up_simulation

__all__ = ["LEAD_S", "Recording", "Simulation", "Stability", "sensor_log", "set_up_simulation"]
