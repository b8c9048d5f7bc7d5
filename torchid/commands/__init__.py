"""Commands: whole runs from files to folders."""

from torchid.commands.analyze import Analysis, analyze
from torchid.commands.evaluate import evaluate
from torchid.commands.identify import identify
from torchid.commands.results import Identification

__all__ = ["Analysis", "Identification", "analyze", "evaluate", "identify"]
