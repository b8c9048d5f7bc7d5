"""Commands: whole runs from files to folders."""

from torchid.run.analysis_results import Analysis
from torchid.run.analyze import analyze
from torchid.run.evaluate import evaluate
from torchid.run.identify import identify
from torchid.run.results import Identification

__all__ = ["Analysis", "Identification", "analyze", "evaluate", "identify"]
