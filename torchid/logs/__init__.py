"""Logs: read and write the file format, filter, differentiate and resample."""

from torchid.logs.column_map import Columns
from torchid.logs.log import Log
from torchid.logs.preprocess import preprocess
from torchid.logs.read import read_log, write_log
from torchid.logs.ros_topics import Topics

__all__ = ["Columns", "Log", "Topics", "preprocess", "read_log", "write_log"]
