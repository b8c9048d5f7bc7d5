"""Logs: read and write the file format, filter, differentiate and resample.

- the format: `log` (fields, shapes), `read`, `containers`, `arrays`, `time_range`, `episodes`
- files of arrays: `array_files`; of tables: `tables`, `table_files`
- bags: `bags`, `bag_files`, `ros_topics`, `unitree`; series with stamps of their own: `alignment`
- maps of columns and arrays to fields: `columns`, `schema`, `units`
- preprocessing: `preprocess`, `timeline`, `low_pass`, `cutoff`, `segments`, `gaps`, `quaternion`, `flags`,
  `dry_friction`, `signal_noise`; of large logs `blocks`, `spill`
"""

from typing import TYPE_CHECKING

import lazy_loader  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from torchid.logs.columns import Columns
    from torchid.logs.log import Log
    from torchid.logs.read import read_log, write_log
    from torchid.logs.ros_topics import Topics

__all__ = ["Columns", "Log", "Topics", "read_log", "write_log"]

__getattr__, __dir__, _ = lazy_loader.attach(  # a process that only opens files needs none of these
    __name__,
    submod_attrs={
        "columns": ["Columns"],
        "log": ["Log"],
        "read": ["read_log", "write_log"],
        "ros_topics": ["Topics"],
    },
)
