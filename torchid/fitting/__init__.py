"""From an experiment's logs to a fit: problem, solution, noise, robust weights, ridge, calibration of new logs."""
