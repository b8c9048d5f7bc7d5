"""From logs to a fit: problem, solution, noise, robust weights, ridge, cross-validation, calibration of new logs.

Only `experiment` and `estimator` know experiment files; the other modules take a robot, a row builder and an estimator.
`factor_files` keeps compressed logs for later fits.
"""
