"""Simulated robots on a floor: motions, exact recordings, and what imperfect sensors make of them."""

from torchid.simulation.motion import LEAD_S
from torchid.simulation.recording import Recording
from torchid.simulation.sensors import sensor_log
from torchid.simulation.simulation import Simulation, set_up_simulation
from torchid.simulation.stability import Stability

__all__ = ["LEAD_S", "Recording", "Simulation", "Stability", "sensor_log", "set_up_simulation"]
