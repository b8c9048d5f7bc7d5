"""Simulated robots on a floor: reference motions, exact recordings, and logs of imperfect sensors."""

from torchid.simulation.simulation import LEAD_S, Recording, Simulation, Stability, sensor_log, set_up_simulation

__all__ = ["LEAD_S", "Recording", "Simulation", "Stability", "sensor_log", "set_up_simulation"]
