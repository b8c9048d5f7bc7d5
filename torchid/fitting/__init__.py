"""From logs to a fit: problem, solution, noise, robust weights, ridge, cross-validation, calibration of new logs;
files of compressed logs.

Only `experiment` and `estimator` know experiment files; the other modules take a robot, a row builder and an estimator.
"""
