"""Simulated robots on a floor: reference motions, exact recordings, and logs of imperfect sensors."""

from torchid.simulation.controller import LEAD_S
from torchid.simulation.simulation import Recording, Simulation, Stability, sensor_log, set_up_simulation

__all__ = ["LEAD_S", "Recording", "Simulation", "Stability", "sensor_log", "set_up_simulation"]
