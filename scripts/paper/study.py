"""Simulate, corrupt, fit, evaluate: the whole experiment of section V."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from paper.fits import Series, compress_groups, predict_series
from paper.results import NOMINAL, TRUE, Ranks, Record, Results
from paper.settings import SHOWN, SQUATS, TRAINING, UNSEEN, Condition, Study, conditions
from torchid import distributed, parameters
from torchid.commands.simulate import perturbed_parameters, simulate
from torchid.config import load_config
from torchid.errors import ConfigError, about_file
from torchid.fitting.experiment import Experiment, set_up
from torchid.logs import Log, read_log
from torchid.logs.preprocess import preprocess
from torchid.parameters import Array
from torchid.problem import Evaluation, Samples, bind_log
from torchid.report.tables import progress_bars
from torchid.simulation import sensor_log


@dataclass(frozen=True)
class _Draw:
    """One draw of a condition: training samples by group, and the unseen log as measured and without imperfections."""

    condition: Condition
    number: int
    groups: Mapping[str, Sequence[Samples]]
    measured: Samples
    exact: Samples


@dataclass(frozen=True)
class _Outcome:
    """What one draw gives: errors of every fit, ranks, and the forces over time, if they are those that are shown."""

    records: list[Record]
    ranks: list[Ranks]
    shown: list[Series]


def _shared(items: Sequence[Any], compute: Callable[[Any], Any], about: str) -> list[Any]:
    """What a function makes of each of some items, in their order, each item the work of one process alone."""
    share = items[distributed.own_share([1] * len(items))]
    with distributed.apart():
        results = [compute(item) for item in share]
    return list(chain.from_iterable(distributed.all_gather(results, about)))


class Reproduction:
    """Runs a study; processes that share the work each take some draws, with the results of one process."""

    def __init__(self, study: Study) -> None:
        """Read the experiment files.

        Raises:
            InputError: the settings do not fit together.
        """
        self.study = study
        self._experiments = {name: self._experiment(path) for name, path in study.experiments.items()}
        first = next(iter(self._experiments.values()))
        for name, experiment in self._experiments.items():
            for key in ("preprocessing", "contacts"):
                found, common = (getattr(e.config, key) for e in (experiment, first))
                if found != common:
                    raise ConfigError(study.experiments[name], key, f"{found}", f"{common}, as in the other files")
        self._robot, self._contacts, self._filter = first.robot, first.contacts, first.config.preprocessing
        self._evaluation = Evaluation(first.robot, first.contacts, first.config.device)

    def run(self) -> tuple[Results, Series]:
        """Run the study.

        Returns:
            Errors of every fit, and forces over time of one of them.

        Raises:
            InputError: the robot falls.
        """
        cases = conditions(self.study.simulation)
        exact = _shared((False, True), self._simulated, "simulation")
        draws = [(case, number) for case in cases for number in range(self._draws(case))]
        share = draws[distributed.own_share([1] * len(draws))]
        with progress_bars() as bars:
            bar = bars.add_task("fitting", total=len(share) * (len(self._experiments) + 1))
            done = partial(bars.advance, bar)

            def examine(draw: tuple[Condition, int]) -> _Outcome:
                case, number = draw
                outcome = self._examine(self._draw(case, number, exact[case.friction]), done)
                done()
                return outcome

            outcomes = _shared(draws, examine, "draws")
        records, found, shown = (
            [x for one in outcomes for x in getattr(one, part)] for part in ("records", "ranks", "shown")
        )
        return Results(records, found), shown[0]

    def _experiment(self, path: Path) -> Experiment:
        """An experiment file, for the study's robot and logs."""
        urdf, logs = json.dumps(str(self.study.simulation.robot.urdf)), "logs={train: [squats], test: []}"
        with about_file(path):
            return set_up(load_config(path, [f"robot.urdf={urdf}", logs]))

    def _draws(self, condition: Condition) -> int:
        return self.study.noise_draws if condition.random else 1

    def _simulated(self, friction: bool) -> dict[str, Log]:
        """Exact logs of the motions, with or without joint friction."""
        config = self.study.simulation
        plant = replace(config.friction, enabled=friction)
        with tempfile.TemporaryDirectory() as folder:
            output = Path(folder) / "simulation"
            simulate(replace(config, output=output, friction=plant))
            return {motion.name: read_log(output / "exact" / f"{motion.name}.npz") for motion in config.motions}

    def _draw(self, condition: Condition, number: int, exact: Mapping[str, Log]) -> _Draw:
        """Corrupt, filter and bind all logs of a condition."""
        clean = conditions(self.study.simulation)[0]

        def samples(name: str, of: Condition) -> Samples:
            log = sensor_log(exact[name], of.sensors, self.study.simulation.seed + number, name)
            log = preprocess(log, self._filter.filter_hz, self._filter.sample_rate_hz)
            return bind_log(log, self._robot, self._contacts)

        groups: dict[str, list[Samples]] = {"squats": [], "others": []}
        for name in exact:
            if not name.startswith(UNSEEN):
                groups["squats" if name.startswith(SQUATS) else "others"].append(samples(name, condition))
        unseen = next(name for name in exact if name.startswith(UNSEEN))
        return _Draw(condition, number, groups, samples(unseen, condition), samples(unseen, clean))

    def _examine(self, draw: _Draw, done: Callable[[], None]) -> _Outcome:
        """Fit every sensor set on every training set from every nominal draw, and evaluate."""
        friction, nominals = draw.condition.friction, self._nominals()
        out = _Outcome([], [], [])
        vectors: dict[str, dict[str, list[Array]]] = {training: {} for training in TRAINING}
        for sensors, experiment in self._experiments.items():
            logs = compress_groups(experiment, draw.groups)
            for training, groups in TRAINING.items():
                vectors[training][sensors] = [fit.phi for fit in logs.fit(groups, nominals, friction)]
                if draw.condition.name == SHOWN[0] and draw.number == 0:
                    out.ranks.append(Ranks(training, sensors, logs.ranks(groups, friction)))
            done()
        true = self._true(friction).flatten()
        for training, fitted in vectors.items():
            rows = {NOMINAL: [nominal.flatten() for nominal in nominals], **fitted, TRUE: [true]}
            out.records.extend(self._evaluate(draw, training, rows))
            if (draw.condition.name, training) == SHOWN and draw.number == 0:
                first = {name: phi[0] for name, phi in rows.items()}
                out.shown.append(predict_series(self._evaluation, draw.exact, first))
        return out

    def _evaluate(self, draw: _Draw, training: str, rows: Mapping[str, Sequence[Array]]) -> Iterator[Record]:
        candidates = np.stack([phi for vectors in rows.values() for phi in vectors])
        measured, exact = (self._evaluation.metrics([log], candidates) for log in (draw.measured, draw.exact))
        labels = [(name, number) for name, vectors in rows.items() for number in range(len(vectors))]
        for (name, number), *metrics in zip(labels, measured, exact, strict=True):
            yield Record(draw.condition.name, training, name, draw.number, number, *metrics)

    def _nominals(self) -> list[Array]:
        """Nominal parameters (L, 12), one per draw."""
        settings = self.study.simulation.nominal
        return [perturbed_parameters(self._robot, settings, draw) for draw in range(self.study.nominal_draws)]

    def _true(self, friction: bool) -> Array:
        """Parameters (L, 12) of the simulated robot."""
        true, levels = self._robot.nominal.copy(), self.study.simulation.friction
        if friction:
            true[1:, parameters.COULOMB], true[1:, parameters.VISCOUS] = levels.coulomb, levels.viscous
        return true
