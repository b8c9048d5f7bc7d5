"""Fisher information of sensor sets, many sets from one pass over the samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from torchid.analysis.candidates import Candidate, sensor_set
from torchid.analysis.information import information_in, prior_directions, unit_readings
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import spread_by_state
from torchid.problem.plan import State
from torchid.problem.threads import one_thread, share_out, worker_count
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise

_SAMPLES = 96  # a contact state: bits change by less than 1 % with four times as many
_ROUNDING = 1e-13


@dataclass(frozen=True)
class _StateRows:
    """Of B samples with all sensors: rows that hang on each candidate, Q (B, c, nv) and Q R (B, c, P)."""

    weight: float
    owners: list[int]
    Q: Tensor
    QR: Tensor


class SetRanking:
    """Bits that any choice from some candidates gives, beside sensors that are there anyway.

    A sensor that is left out takes one row per sample and channel with it: with R the whitened rows of all sensors and
    c the way its channel enters the generalized force, L^-1 Q R, where Q = c^T W and L L^T = Q Q^T.
    """

    @one_thread()
    @torch.no_grad()
    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        logs: Sequence[Samples],
        candidates: Sequence[Candidate],
        others: Sequence[Candidate],
        noise: SensorNoise,
        prior: Array,
    ) -> None:
        """Work out the rows of all sensors together.

        Args:
            robot: the robot.
            contacts: its contacts.
            logs: samples to weigh the sensors by; forces in them do not matter.
            candidates: to choose from.
            others: sensors that are there in any case.
            noise: of all sensors.
            prior: (12 L,), how far parameters may be off the nominal ones, 0 where they are known.
        """
        self.candidates = tuple(candidates)
        sensors = sensor_set(robot, contacts, [*candidates, *others], noise)
        builder = RowBuilder(robot, contacts, sensors)
        directions = torch.from_numpy(prior_directions(builder, prior))
        self._states: list[_StateRows] = []
        self._information = torch.eye(directions.shape[1], dtype=torch.float64)
        for samples, state, stands_for in spread_by_state(logs, _SAMPLES):
            weight = stands_for / samples.oversampling
            rows, W = builder.rows_by_sample(samples, state)
            R = rows[..., :-1] @ directions
            self._information += information_in(R, weight)
            owners, ways = self._ways(builder, samples, state)
            if owners:
                Q = unit_readings(ways, W)
                self._states.append(_StateRows(weight, owners, Q, Q @ R))

    def _ways(self, builder: RowBuilder, samples: Samples, state: State) -> tuple[list[int], Tensor]:
        """How each channel of the candidates enters the generalized force, (B, c, nv), and whose channel it is."""
        J = builder.contact_jacobian(samples)
        base, owners, ways = builder.tree.base_rows, [], []
        for number, candidate in enumerate(self.candidates):
            for dof in candidate.dofs:
                way = J.new_zeros(len(samples), J.shape[-1])
                way[:, base + dof] = 1.0
                ways.append(way)
                owners.append(number)
            if candidate.contact is not None and state[candidate.contact]:
                ways += [J[:, candidate.contact, k] for k in candidate.components]
                owners += [number] * len(candidate.components)
        return owners, torch.stack(ways, dim=1) if ways else J.new_zeros(len(samples), 0, J.shape[-1])

    @one_thread()
    @torch.no_grad()
    def bits(self, chosen: Iterable[Candidate]) -> float:
        """Information [bits] about the parameters, against knowing each to within its prior."""
        kept = {self.candidates.index(candidate) for candidate in chosen}
        information = self._information
        for rows in self._states:
            gone = [row for row, owner in enumerate(rows.owners) if owner not in kept]
            if gone:
                Q = rows.Q[:, gone]
                gram = Q @ Q.mT
                gram.diagonal(dim1=1, dim2=2).add_(_ROUNDING)  # channels that read alike, or nothing
                lost = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows.QR[:, gone], upper=False)
                information = information - information_in(lost, rows.weight)
        return float(0.5 * torch.linalg.slogdet(information).logabsdet / np.log(2.0))


def best_first(
    ranking: SetRanking, sets: Sequence[tuple[Candidate, ...]], done: Callable[[], None] | None = None
) -> list[tuple[float, tuple[Candidate, ...]]]:
    """Sets with their bits, most informative first; `done` is told of each, from several threads."""

    def run(places: Iterator[int]) -> list[tuple[float, int]]:
        found = []
        for place in places:
            found.append((-ranking.bits(sets[place]), place))
            if done is not None:
                done()
        return found

    workers = min(worker_count(torch.device("cpu")), max(len(sets), 1))
    found = sorted(chain.from_iterable(share_out(range(len(sets)), run, workers)))
    return [(-bits, sets[place]) for bits, place in found]
