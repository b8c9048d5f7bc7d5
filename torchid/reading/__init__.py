"""From log files to samples of a robot: whole, or in blocks where they are larger than memory.

- a log: `log_reader`; larger than memory `large_log`, in segments `segmented_log`
"""
