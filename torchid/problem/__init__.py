"""From bound logs to a compressed linear problem."""

from torchid.problem.batches import Batch, MiniBatches
from torchid.problem.elimination import assemble
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import LinearProblem
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, bind
from torchid.problem.streaming import compress, compress_parts, linear_problem
from torchid.problem.triangular import TriangularFactor

__all__ = [
    "Batch",
    "ExtraTerms",
    "LinearProblem",
    "MiniBatches",
    "RowBuilder",
    "Samples",
    "TriangularFactor",
    "assemble",
    "bind",
    "compress",
    "compress_parts",
    "linear_problem",
]
