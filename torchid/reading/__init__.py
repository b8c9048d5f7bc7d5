"""From log files to samples of a robot: `log_reader` reads them, `log_steps` has the order of what happens to each."""
