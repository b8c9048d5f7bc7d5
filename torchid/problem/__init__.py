"""From bound logs to a compressed linear problem."""

from torchid.problem.batches import Batch, MiniBatches
from torchid.problem.linear import LinearProblem
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, bind
from torchid.problem.streaming import compress, linear_problem
from torchid.problem.triangular import TriangularFactor

__all__ = [
    "Batch",
    "LinearProblem",
    "MiniBatches",
    "RowBuilder",
    "Samples",
    "TriangularFactor",
    "bind",
    "compress",
    "linear_problem",
]
