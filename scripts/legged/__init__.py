"""Legged robots unlike their URDFs: simulated, recorded, and how far identified parameters are from the truth."""
