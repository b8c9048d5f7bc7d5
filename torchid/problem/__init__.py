"""From bound logs to a compressed linear problem."""

from torchid.problem.batches import Batch, MiniBatches
from torchid.problem.compression import compress, compress_parts
from torchid.problem.elimination import assemble, linear_problem
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import LinearProblem, TriangularFactor
from torchid.problem.metrics import Evaluation, Metrics
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, bind_log

__all__ = [
    "Batch",
    "Evaluation",
    "ExtraTerms",
    "LinearProblem",
    "Metrics",
    "MiniBatches",
    "RowBuilder",
    "Samples",
    "TriangularFactor",
    "assemble",
    "bind_log",
    "compress",
    "compress_parts",
    "linear_problem",
]
