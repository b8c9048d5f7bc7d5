"""Commands: whole runs from files to folders."""

from torchid.run.evaluate import evaluate
from torchid.run.identify import Identification, identify

__all__ = ["Identification", "evaluate", "identify"]
