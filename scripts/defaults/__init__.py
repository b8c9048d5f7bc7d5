"""Simulated robots whose truth is known, their flawed logs, and what torchid's defaults make of them."""
