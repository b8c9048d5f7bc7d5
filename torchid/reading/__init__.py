"""From log files to samples of a robot: `log_reader` reads them and has the order of what happens to each."""
