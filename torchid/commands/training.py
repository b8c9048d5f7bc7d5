"""A descent as part of a run: progress, curves and whole checkpoints, and going on after an interruption."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from rich.progress import Progress

from torchid import distributed, parameters
from torchid.commands.folder import (
    CHECKPOINT,
    EVENTS,
    TRAINING,
    check_free,
    inspect_folder,
    new_folder,
    recover_leftovers,
    refuse_inputs,
    refuse_link,
)
from torchid.config import ExperimentConfig, dump_config, inputs_of
from torchid.config.settings_files import check_yaml
from torchid.errors import ConfigError, InputError, SensorError, excerpt, warn
from torchid.estimators import Conditions, Epoch, Estimate, Sgd, SgdEstimate, Trainer
from torchid.estimators.least_squares import IDENTIFIED
from torchid.estimators.sgd import FULL_BATCH
from torchid.fitting.experiment import Experiment
from torchid.fitting.fit import LogFitter
from torchid.guards import check_regular
from torchid.parameters import PARAMETERS, Array
from torchid.problem import (
    Evaluation,
    LinearProblem,
    Metrics,
    MiniBatches,
    Samples,
    assemble,
    compress_parts,
)
from torchid.problem.compression import Part
from torchid.problem.elimination import Assembly
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import LOG_SETS
from torchid.robot import Robot

if TYPE_CHECKING:
    from torchid.report.tensorboard import RunEvents

Evaluate = Callable[[Array], Mapping[str, Metrics]]
"""Errors of parameters (12 L,) by set of logs."""
_FREE_TO_CHANGE = ("output", "overwrite", "figures.format")
_SAME = 1e-9  # relative: the logs of a checkpoint, up to rounding


def training_folder(output: Path) -> Path:
    """Where a run that trains keeps checkpoint and curves until it is done."""
    return output.with_name(f"{output.name}.training")


def require_trainable(config: ExperimentConfig, resume: bool) -> None:
    """Make sure, before any work, that a training may start or go on.

    Raises:
        ConfigError: nothing to go on with, or an unfinished training in the way.
    """
    output = config.output
    inputs = inputs_of(config)
    if config.estimator.name != "sgd" or output is None:
        if resume:
            sgd = config.estimator.name == "sgd"
            reason = "needs an output" if sgd else f"{config.estimator.name} has nothing to resume"
            accepted = "an output with an unfinished run" if sgd else "estimator.name: sgd, or no --resume"
            raise ConfigError.at_field("--resume", reason, accepted)
        return
    folder = training_folder(output)
    refuse_link(folder)
    recover_leftovers(folder, TRAINING)
    waiting = (folder / CHECKPOINT).is_file()
    if resume and not waiting:
        if output.exists() and not config.overwrite:
            raise ConfigError(output, "--resume", "a finished run", "an unfinished one, or overwrite=true")
        message = f"{folder}: no checkpoint found. Training starts from the beginning."
        warn(message)
    elif waiting and not resume and not config.overwrite:
        raise ConfigError(folder, "output", "an unfinished training", "--resume, overwrite=true, or another output")
    if not waiting or not resume:
        check_free(folder, True, TRAINING, inputs)  # without a checkpoint there is nothing to lose
    refuse_inputs(folder, inputs)  # it goes when the run is done


class Training:
    """The descent of one run, which leaves its state in a folder of its own until the run is done.

    Attributes:
        folder: that folder; None where nothing is to be written.
    """

    def __init__(self, experiment: Experiment) -> None:
        """Fix the settings. Raises InputError: optimizer, schedule or a number that cannot be."""
        config = experiment.config
        self.config = config
        self.robot = experiment.robot
        self.folder = None if config.output is None else training_folder(config.output)
        self.settings = descent_settings(config, experiment.conditions())
        self._text = dump_config(config)
        self._saved = 0

    def run(
        self,
        parts: Sequence[Part],
        problem: LinearProblem,
        fitter: LogFitter,
        logs: Mapping[str, Sequence[Samples]],
        evaluation: Evaluation,
        bars: Progress,
        resume: bool,
    ) -> SgdEstimate:
        """Train until finished; what is interrupted can be resumed.

        Args:
            parts: the training logs, compressed.
            problem: that they pose, with what is free.
            fitter: of their rows.
            logs: "train", "validation" and "test".
            evaluation: of the forces of these and of the test logs, for the curves.
            bars: for the progress.
            resume: whether to go on from the checkpoint, if there is one.

        Raises:
            SensorError: nothing to learn.
            InputError: the checkpoint belongs to other settings or logs; the descent diverged.
            KeyboardInterrupt: says how to go on.
        """
        training = self.config.estimator.training
        builder = fitter.builder
        (size, seed, share) = (training.batch_size, training.seed, self._share())
        sampled = sampled_rows(fitter, parts)
        train = MiniBatches(logs["train"], builder, size, seed, share=share, assembly=sampled)
        held_out = None
        if logs["validation"]:  # with the extra parameters that fit these logs best
            held_out_rows = sampled_rows(fitter, compress_parts(logs["validation"], builder))
            held_out = MiniBatches(logs["validation"], builder, size, seed, share=share, assembly=held_out_rows)
        trainer = Trainer(self.settings, problem, train, held_out, data=sampled.problem)
        if not trainer.closed_form.rank:
            raise SensorError.at_field("sensors", "they determine no parameter", "other sensors or contacts")
        state = distributed.from_first(partial(self._prepare, trainer, resume), "checkpoint")
        if state is not None:
            if not distributed.is_first():
                trainer.load_state_dict(state)
            self._saved = trainer.epoch
        bar = bars.add_task("training", total=self.settings.epochs, completed=trainer.epoch)
        since = trainer.epoch + 1 if trainer.epoch else 0

        def evaluate(phi: Array) -> dict[str, Metrics]:
            return {name: evaluation.metrics(logs[name], phi[None])[0] for name in LOG_SETS if logs[name]}

        with self._interruptible(trainer), self._curves(since) as events:
            if events is not None:
                known = known_parameters(self.robot, trainer.closed_form, trainer.phi())
                events.write_layout(self.robot.body_names, list(known))
            if trainer.epoch == 0:
                self._evaluate(trainer, evaluate, events)
                self._save(trainer, events)
            self._train(trainer, evaluate, events, lambda text: bars.update(bar, advance=1, description=text))
        return trainer.estimate()

    def copy_curves(self, folder: Path) -> None:
        """Copy the training's event files into the finished run's folder."""
        for path in () if self.folder is None else self.folder.glob(EVENTS):
            shutil.copy2(path, folder)

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint of a run that is done.

        Warns:
            TorchidWarning: there is more in its folder than torchid wrote.
        """
        if self.folder is None:
            return
        if contents := inspect_folder(self.folder, TRAINING):
            contents.remove()
        if self.folder.exists():
            message = f"{self.folder}: not removed, as it has files that torchid did not write."
            warn(message)

    def _curves(self, since: int) -> AbstractContextManager[RunEvents | None]:
        """What the first process writes curves with, from an epoch on."""
        if self.folder is None or not distributed.is_first():
            return nullcontext()
        from torchid.report.tensorboard import RunEvents  # as in `write_events`

        return RunEvents(self.folder, since)

    def _share(self) -> tuple[int, int]:
        """The part of every batch that this process takes; all take all of it where a line search asks for more."""
        name = self.config.estimator.training.optimizer["name"]
        return (0, 1) if name in FULL_BATCH else (distributed.rank(), distributed.world_size())

    def _train(
        self, trainer: Trainer, evaluate: Evaluate, events: RunEvents | None, progress: Callable[[str], None]
    ) -> None:
        training = self.config.estimator.training
        saved = time.monotonic()
        while not trainer.finished:
            epoch = trainer.run_epoch()
            if events is not None:
                events.write_epoch(epoch)
            if epoch.number % training.evaluate_every == 0 or trainer.finished:
                self._evaluate(trainer, evaluate, events)
            if time.monotonic() - saved >= training.checkpoint_seconds or trainer.finished:
                self._save(trainer, events)
                saved = time.monotonic()
            progress(_described(epoch))

    def _evaluate(self, trainer: Trainer, evaluate: Evaluate, events: RunEvents | None) -> None:
        step = trainer.epoch
        phi = trainer.phi()
        errors = evaluate(phi)
        if events is not None:
            events.write_errors(step, errors, by_epoch=True)
            events.write_eigenvalues(step, body_eigenvalues(self.robot, phi), by_epoch=True)
            events.write_parameters(step, known_parameters(self.robot, trainer.closed_form, phi), by_epoch=True)

    def _prepare(self, trainer: Trainer, resume: bool) -> dict[str, Any] | None:
        """Start a new folder, or take up what is in it: the state of the trainer there."""
        if self.folder is None:
            return None
        if resume and (self.folder / CHECKPOINT).is_file():
            state = load_checkpoint(self.folder)
            with refusing_damage(self.folder):
                self._check(state, trainer, self.folder / CHECKPOINT)
                trainer.load_state_dict(state["trainer"])
            trainer_state: dict[str, Any] = state["trainer"]
            return trainer_state
        with new_folder(self.folder, True, TRAINING) as folder:
            (folder / "config.yaml").write_text(self._text)
        return None

    def _save(self, trainer: Trainer, events: RunEvents | None) -> None:
        self._saved = trainer.epoch
        if events is None or self.folder is None:  # the first process saves
            return
        events.flush()  # first: a resumed run's curves start where the checkpoint is
        state = {"config": self._text, "logs": _fingerprint(trainer), "trainer": trainer.state_dict()}
        save_checkpoint(self.folder, state)

    def _check(self, state: Mapping[str, Any], trainer: Trainer, path: Path) -> None:
        if set(state) != {"config", "logs", "trainer"}:
            raise InputError(path, "file", "not a checkpoint of a run", "a checkpoint written by torchid identify")
        check_yaml(state["config"])
        before, now = (yaml.safe_load(text) for text in (state["config"], self._text))
        for key, old, new in _differences(before, now):
            if key not in _FREE_TO_CHANGE:
                raise ConfigError.at_field(key, f"{new}, but the checkpoint has {old}", "the same settings")
        rows, cost = _fingerprint(trainer)
        if state["logs"][0] != rows or abs(state["logs"][1] - cost) > _SAME * cost:
            raise ConfigError.at_field("logs", "differ from those of the checkpoint", "the same files, unchanged")

    @contextmanager
    def _interruptible(self, trainer: Trainer) -> Iterator[None]:
        try:
            yield
        except KeyboardInterrupt as error:
            stopped = f"interrupted in epoch {trainer.epoch}"
            if self.folder is not None:
                stopped = f"{stopped}. Use --resume to continue after epoch {self._saved}."
            raise KeyboardInterrupt(stopped) from error
        except InputError:  # it would diverge again; the curves stay, to be looked at
            if distributed.is_first() and self.folder is not None:
                (self.folder / CHECKPOINT).unlink(missing_ok=True)
            raise


_CHECKPOINT_ACCEPTED = "a checkpoint written by torchid"
_DIGEST_BYTES = hashlib.sha256().digest_size


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a state of plain types and tensors behind its SHA-256, under a temporary name first.

    Raises:
        OSError: names the file, if the disk is full or cannot be written.
    """
    path = folder / CHECKPOINT
    temporary = folder / f".{CHECKPOINT}"
    stream = io.BytesIO()
    torch.save(state, stream)
    content = stream.getvalue()
    try:
        with temporary.open("wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def load_checkpoint(folder: Path) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote; no code in the file is run.

    Raises:
        InputError: the file is damaged, was changed, or is none of ours.
    """
    path = folder / CHECKPOINT
    with refusing_damage(folder):
        check_regular(path)
        whole = path.read_bytes()
        content = whole[_DIGEST_BYTES:]
        if hashlib.sha256(content).digest() != whole[:_DIGEST_BYTES]:
            raise ValueError("its checksum is wrong")
        state = torch.load(io.BytesIO(content), weights_only=True)
    if not isinstance(state, dict):
        raise InputError(path, "file", f"contains a {type(state).__name__}", _CHECKPOINT_ACCEPTED)
    return state


@contextmanager
def refusing_damage(folder: Path) -> Iterator[None]:
    """Turn whatever reading a checkpoint or taking up its state raises into one line that names the file.

    Raises:
        InputError: a checkpoint whose parts are not what they should be.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # noqa: B902 - an unpickler, torch and its optimizers raise what they like
        reason = f"not readable ({excerpt(str(error) or type(error).__name__, 200)})"
        raise InputError(folder / CHECKPOINT, "file", reason, _CHECKPOINT_ACCEPTED) from error


def sampled_rows(fitter: LogFitter, parts: Sequence[Part]) -> Assembly:
    """The problem of the rows of samples alone: no corrections for noise, known masses or readings in the air."""
    plain = []
    for part in parts:
        if not part.unloaded:
            plain.append(replace(part, factor=replace(part.factor, noise_gram={})))
    assembly = assemble(plain, fitter.builder, fitter.robot, fitter.friction)
    frozen = np.zeros(assembly.problem.free.shape, dtype=bool) if fitter.frozen is None else fitter.frozen
    return replace(assembly, problem=replace(assembly.problem, free=assembly.problem.free & ~frozen))


def descent_settings(config: ExperimentConfig, conditions: Conditions | None = None) -> Sgd:
    """What an experiment file says of a descent.

    Raises:
        InputError: an optimizer or schedule that torch does not have or that does not take its options.
    """
    settings = config.estimator.sgd(conditions or Conditions(margin=config.estimator.margin))
    try:
        settings.try_out()
    except InputError as error:
        raise ConfigError.at_field(f"estimator.training.{error.field}", error.found, error.accepted) from error
    return settings


def body_eigenvalues(robot: Robot, phi: Array) -> dict[str, float]:
    """Smallest eigenvalue of every body's scaled pseudo-inertia, by name, of parameters (12 L,)."""
    least = parameters.least_eigenvalues(phi, parameter_scale(robot.nominal).flatten())
    return {name: float(x) for name, x in zip(robot.body_names, least, strict=True) if x == x}


def known_parameters(robot: Robot, estimate: Estimate, phi: Array) -> dict[str, tuple[float, float]]:
    """Parameters (12 L,) that an estimate identifies one by one, with its standard errors, by `body.parameter`."""
    names = [f"{body}.{parameter}" for body in robot.body_names for parameter in PARAMETERS]
    known = (estimate.verdict == IDENTIFIED) & np.isfinite(estimate.standard_error)
    return {names[k]: (float(phi[k]), float(estimate.standard_error[k])) for k in np.flatnonzero(known)}


def _described(epoch: Epoch) -> str:
    return f"training, loss {epoch.losses['data']:.4g}"


def _fingerprint(trainer: Trainer) -> tuple[int, float]:
    return trainer.problem.rows, trainer.problem.cost(trainer.problem.nominal)


def _differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Keys, as in `estimator.ridge`, whose values differ between two settings, with both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in dict.fromkeys([*before, *now]):
            yield from _differences(before.get(name), now.get(name), f"{key}.{name}" if key else str(name))
    elif before != now:
        yield key, before, now
