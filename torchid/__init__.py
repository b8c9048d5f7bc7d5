"""Inertial and friction parameters of floating-base robots from logs with partial force sensing.

Building blocks are here, imported on first use: torch and the kinematics take seconds, which `torchid --help` should
not. Whole runs, from files to folders, are in `torchid.commands`, experiment files in `torchid.config`.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
