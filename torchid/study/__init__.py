"""The paper's experiment: sensor sets compared on a simulated biped, under every sensor imperfection."""

from torchid.study.paper import Reproduction
from torchid.study.results import Results
from torchid.study.settings import Study

__all__ = ["Reproduction", "Results", "Study"]
