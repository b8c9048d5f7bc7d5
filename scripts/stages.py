"""Where the time of a compression goes, stage by stage, and how far each stage is from what the machine allows.

The floor of a stage is the time of a product of large matrices with as many operations as the stage needs, and of a
copy of the bytes that it must read and write, both at the rates of this device. Operations and bytes are counted from
the equations, not from what torchid does: a stage that works something out twice is further from its floor.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from unittest.mock import patch

import torch
from rich.table import Table

from torchid import kernels, parameters
from torchid.parallel import one_thread
from torchid.problem import RowBuilder, Samples, compress
from torchid.problem.chunks import chunk_size, chunks_by_state
from torchid.problem.contact_state import ContactState
from torchid.problem.rows import Workspace

STAGES = ("kinematics, wrench columns", "null space W", "projection to rows", "factorization")
_NUMBER = 8  # bytes
_MATRIX, _COPIED = 1024, 2**25  # rows of the square matrices that are multiplied, numbers that are copied
_POSE, _COLUMN = 150, 40  # operations for the pose, twist and acceleration of a body, and for one wrench column
Chunk = tuple[Samples, ContactState]


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def seconds(work: Callable[[], object], device: torch.device, repeats: int = 5) -> float:
    """Median time of a call: wall time on a GPU, else time of this thread's processor, as others may use it too."""
    clock, times = (time.perf_counter if device.type == "cuda" else time.thread_time), []
    work()
    for _ in range(repeats):
        synchronize(device)
        start = clock()
        work()
        synchronize(device)
        times.append(clock() - start)
    return statistics.median(times)


@dataclass(frozen=True)
class Limits:
    """Rates of a device: products of large float64 matrices [1/s], copies within it and from the host [bytes/s]."""

    operations: float
    copied: float
    uploaded: float | None

    @classmethod
    def of(cls, device: torch.device) -> Limits:
        """Measure them, on a CPU with one thread."""
        with one_thread():
            a = torch.randn(_MATRIX, _MATRIX, dtype=torch.float64, device=device)
            product, x = torch.empty_like(a), torch.zeros(_COPIED, dtype=torch.float64, device=device)
            copy, uploaded = torch.empty_like(x), None
            operations = 2 * _MATRIX**3 / seconds(lambda: torch.matmul(a, a, out=product), device)
            copied = 2 * x.nbytes / seconds(lambda: copy.copy_(x), device)
            if device.type == "cuda":
                locked = torch.zeros(_COPIED, dtype=torch.float64).pin_memory()
                uploaded = x.nbytes / seconds(lambda: x.copy_(locked, non_blocking=True), device)
        return cls(operations, copied, uploaded)

    def __str__(self) -> str:
        upload = "" if self.uploaded is None else f", host to device {self.uploaded / 1e9:.1f} GB/s"
        return f"float64 products {self.operations / 1e9:.1f} GF/s, copies {self.copied / 1e9:.1f} GB/s{upload}"

    def floor(self, need: Need) -> float:
        """Least time for what a stage needs [s]."""
        return need.operations / self.operations + _NUMBER * need.numbers / self.copied


@dataclass
class Need:
    """What a stage needs at least: operations, and numbers read and written."""

    operations: float = 0.0
    numbers: float = 0.0

    def add(self, operations: float, numbers: float) -> None:
        """More of both."""
        self.operations += operations
        self.numbers += numbers


@dataclass
class Stages:
    """Time of each stage and of its floor, per sample [µs]."""

    measured: dict[str, float] = field(default_factory=dict)
    floor: dict[str, float] = field(default_factory=dict)


def measure_stages(builder: RowBuilder, samples: Samples, limits: Limits) -> Stages:
    """Measure one pass over some samples, on a CPU with one thread.

    Stages follow each other through the same calls as in a fit without kernels, which do several stages at once; the
    later ones are differences of longer passes.
    """
    device = builder.device
    size = chunk_size(device)
    with torch.no_grad(), one_thread(), patch.object(kernels, "compiled", return_value=None):
        chunks = [(samples[index].to(device), state) for state, index in chunks_by_state(samples, size)]
        kinematics = [(state, builder.kinematics(chunk)) for chunk, state in chunks]
        workspace = Workspace()

        def columns() -> None:
            for chunk, _ in chunks:
                builder.dynamics(chunk, workspace)

        def bases() -> None:
            for state, known in kinematics:
                layout = builder.layout(state)
                if layout.contact_bodies:
                    contact = builder.contact_rows(layout, known)
                    exhaust(builder.whitened_bases(layout, contact, known))

        def rows() -> None:
            for chunk, state in chunks:
                exhaust(builder.rows(chunk, state, workspace))

        passes = [seconds(work, device) for work in (columns, bases, rows)]
        passes.append(seconds(lambda: compress([samples], builder, size, threads=1), device))
        first, second, up_to_rows, whole = passes
        measured = (first, second, up_to_rows - first - second, whole - up_to_rows)
        floors = [limits.floor(need) for need in needs(builder, chunks)]
    out = Stages()
    for name, took, least in zip(STAGES, measured, floors, strict=True):
        out.measured[name], out.floor[name] = 1e6 * took / len(samples), 1e6 * least / len(samples)
    return out


def exhaust(items: Iterator[object]) -> None:
    """Go through all items."""
    for _ in items:
        pass


def needs(builder: RowBuilder, chunks: Sequence[Chunk]) -> tuple[Need, Need, Need, Need]:
    """What the four stages need for some chunks, in their order."""
    tree, layout = builder.tree, builder.columns.layout
    kinematics, null_space, projection, factorization = (Need() for _ in STAGES)
    # a wrench times a screw axis; inertias have no force
    operations = [12 if column < parameters.INERTIA.start else 6 for body in layout.kept for column in body]
    for chunk, state in chunks:
        plan, count = builder.layout(state), len(chunk)
        m = tree.base_rows + len(plan.coupled_joints)
        k = sum(body.count for body in plan.contact_bodies)
        r = m - k
        kinematics.add(
            count * (_POSE * tree.n_nodes + _COLUMN * layout.count),
            count * (3 * tree.n + 9 + 24 * tree.n_nodes + 6 * layout.count),
        )
        factorize, apply = 2 * m * k**2 - 2 * k**3 / 3, 4 * m * r * k - 2 * r * k**2
        null_space.add(count * (12 * k * m + factorize + apply), count * (k * m + m * r))
        projection.add(count * r * 12 * tree.n_nodes, count * (6 * layout.count + m * r))
        for support, rows in builder.rows(chunk, state):
            width = len(support) + 1
            projected = sum(operations[column] for column in support if column < layout.count)
            projection.add(rows.shape[0] * projected, rows.shape[0] * width)
            factorization.add(2.0 * rows.shape[0] * width**2, rows.shape[0] * width)
    return kinematics, null_space, projection, factorization


def stage_table(by_case: dict[str, Stages], limits: Limits, device: torch.device) -> Table:
    """Microseconds per sample, those of the floor, and how many times as long the stage takes, for every case."""
    where = "one thread" if device.type == "cpu" else str(device)
    table = Table(title=f"Stages of a compression, {where}: µs per sample, floor, times the floor\n{limits}")
    table.add_column("")
    for name in by_case:
        table.add_column(name, justify="right")
    for stage in STAGES:
        table.add_row(stage, *(cell(x.measured[stage], x.floor[stage]) for x in by_case.values()))
    sums = [(sum(x.measured.values()), sum(x.floor.values())) for x in by_case.values()]
    table.add_row("all", *(cell(*pair) for pair in sums))
    return table


def cell(measured: float, floor: float) -> str:
    """One stage of one case."""
    return f"{measured:.2f}  {floor:.2f}  {measured / floor:.1f}"
