"""From bound logs to a compressed linear problem.

- a log bound to a robot: `samples`, `log_joints`, `motion`
- contacts, from forces and motion: `contact_detection`, `contact_slip`, `unloaded_sensors`; the base's pose from
  feet: `base_pose`
- rows: `rows`, `contact_state`, `null_bases`, `extras`; compiled `compiled_rows`; in mini-batches `batches`
- factors: `chunks`, `compression`, `row_compressor`, `noise_gram`
- the problem: `linear`, `elimination`, `noise`
- predictions of its parameters: `metrics`
"""

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
