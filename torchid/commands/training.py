"""A descent as part of a run: progress, curves and whole checkpoints, and going on after an interruption."""

from __future__ import annotations

import glob
import hashlib
import io
import os
import shutil
import socket
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from rich.progress import Progress

from torchid import parameters, ranks
from torchid.commands.folder import (
    EVENTS,
    TRAINING,
    check_free,
    new_folder,
    recover_leftovers,
    refuse_inputs,
    refuse_link,
)
from torchid.commands.manifest import Manifest, inspect_folder, read_manifest
from torchid.config import ExperimentConfig, dump_config, inputs_of
from torchid.config.reading import check_yaml
from torchid.errors import ConfigError, InputError, SensorError, excerpt, warn
from torchid.estimators import Epoch, Sgd, SgdEstimate, Trainer
from torchid.estimators.optimizers import OPTIMIZERS
from torchid.fitting.experiment import Experiment
from torchid.guards import MAX_STATE, check_regular
from torchid.parameters import Array
from torchid.problem import LinearProblem, Metrics, MiniBatches, RowBuilder, Samples
from torchid.problem.linear import parameter_scale
from torchid.report.tensorboard import RunEvents
from torchid.robot import Robot

CHECKPOINT = "checkpoint.pt"

_ACCEPTED = "a checkpoint that torchid wrote"
_DIGEST = "digest"
Evaluate = Callable[[Array], Mapping[str, Metrics]]
_FREE_TO_CHANGE = ("output", "overwrite")
_SAME = 1e-9  # relative: the logs of a checkpoint, up to rounding


def training_folder(output: Path) -> Path:
    """Where a run that trains keeps checkpoint and curves until it is done."""
    return output.with_name(f"{output.name}.training")


def require_trainable(config: ExperimentConfig, resume: bool) -> None:
    """Make sure, before any work, that a training may start or go on.

    Raises:
        ConfigError: nothing to go on with, or an unfinished training in the way.
    """
    folder, output, inputs = training_folder(config.output), config.output, inputs_of(config)
    if config.estimator.name != "sgd":
        if resume:
            found = f"{config.estimator.name}, which is done in one go"
            raise ConfigError.at_field("--resume", found, "estimator.name: sgd, or no --resume")
        return
    refuse_link(folder)
    recover_leftovers(folder, TRAINING)
    waiting = (folder / CHECKPOINT).is_file()
    if resume and not waiting:
        if output.exists() and not config.overwrite:
            raise ConfigError(output, "--resume", "a finished run", "an unfinished one, or overwrite=true")
        message = f"{folder}: no checkpoint to go on from; training starts at the beginning"
        warn(message)
    elif waiting and not resume and not config.overwrite:
        raise ConfigError(folder, "output", "an unfinished training", "--resume, overwrite=true, or another output")
    if not waiting or not resume:
        check_free(folder, True, TRAINING, inputs)  # without a checkpoint there is nothing to lose
    refuse_inputs(folder, inputs)  # it goes when the run is done


class Training:
    """The descent of one run, which leaves its state in a folder of its own until the run is done."""

    def __init__(self, experiment: Experiment) -> None:
        """Fix the settings.

        Raises:
            InputError: optimizer, schedule or a number that cannot be.
        """
        config = experiment.config
        self.config, self.robot = config, experiment.robot
        self.folder = training_folder(config.output)
        self.settings = descent_settings(config)
        self._text, self._saved = dump_config(config), 0

    def run(
        self,
        problem: LinearProblem,
        builder: RowBuilder,
        logs: Mapping[str, Sequence[Samples]],
        evaluate: Evaluate,
        bars: Progress,
        resume: bool,
    ) -> SgdEstimate:
        """Train until finished; what is interrupted can be resumed.

        Args:
            problem: compressed training logs, with what is free.
            builder: of their rows.
            logs: "train" and "validation".
            evaluate: metrics on sets of logs, of one parameter vector (12 L,).
            bars: for the progress.
            resume: whether to go on from the checkpoint, if there is one.

        Raises:
            SensorError: nothing to learn.
            InputError: the checkpoint belongs to other settings or logs; the descent diverged.
            KeyboardInterrupt: says how to go on.
        """
        training = self.config.estimator.training
        train, held_out = (
            MiniBatches(logs[name], builder, training.batch_size, training.seed, share=self._share())
            for name in ("train", "validation")
        )
        trainer = Trainer(self.settings, problem, train, held_out if held_out.samples else None)
        if not trainer.closed_form.rank:
            raise SensorError.at_field("sensors", "no parameter is in reach of them", "other sensors or contacts")
        state = ranks.from_first(partial(self._prepare, trainer, resume), "checkpoint")
        if state is not None:
            if not ranks.is_first():
                trainer.load_state_dict(state)
            self._saved = trainer.epoch
        bar = bars.add_task("training", total=self.settings.epochs, completed=trainer.epoch)
        since = trainer.epoch + 1 if trainer.epoch else 0
        curves = partial(RunEvents, self.folder, self.robot.body_names, True, since)
        with self._interruptible(trainer), curves() if ranks.is_first() else nullcontext() as events:
            if trainer.epoch == 0:
                self._evaluate(0, trainer.phi(), evaluate, events)
                self._save(trainer, events)
            self._train(trainer, evaluate, events, lambda text: bars.update(bar, advance=1, description=text))
        return trainer.estimate()

    def copy_curves(self, folder: Path) -> None:
        """Copy the training's event files into the finished run's folder."""
        contents = inspect_folder(self.folder, TRAINING)
        for path in contents.own if contents else ():
            if fnmatchcase(path.name, EVENTS):
                shutil.copy2(path, folder)

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint of a run that is done.

        Warns:
            TorchidWarning: there is more in its folder than torchid wrote.
        """
        if contents := inspect_folder(self.folder, TRAINING):
            contents.remove()
        if self.folder.exists():
            message = f"{self.folder}: stays: it holds what torchid did not write"
            warn(message)

    def _share(self) -> tuple[int, int]:
        """The part of every batch that this process takes; all take all of it where a line search asks for more."""
        name = self.config.estimator.training.optimizer["name"]
        return (0, 1) if OPTIMIZERS[name].full_batch else (ranks.rank(), ranks.world_size())

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
                self._evaluate(epoch.number, trainer.phi(), evaluate, events)
            if time.monotonic() - saved >= training.checkpoint_seconds or trainer.finished:
                self._save(trainer, events)
                saved = time.monotonic()
            progress(_described(epoch))

    def _evaluate(self, step: int, phi: Array, evaluate: Evaluate, events: RunEvents | None) -> None:
        errors = evaluate(phi)
        if events is not None:
            events.write_errors(step, errors)
            events.write_eigenvalues(step, body_eigenvalues(self.robot, phi))

    def _prepare(self, trainer: Trainer, resume: bool) -> dict[str, Any] | None:
        """Start a new folder, or take up what is in it: the state of the trainer there."""
        if resume and (self.folder / CHECKPOINT).is_file():
            state = load_checkpoint(self.folder)
            with refusing_damage(self.folder):
                self._check(state, trainer)
                trainer.load_state_dict(state["trainer"])
            before = read_manifest(self.folder) or Manifest(TRAINING.name, self.folder.name, {})
            replace(before, growing=(*before.growing, *_growing())).write(self.folder)
            found: dict[str, Any] = state["trainer"]
            return found
        with new_folder(self.folder, True, TRAINING, _growing()) as folder:
            (folder / "config.yaml").write_text(self._text)
        return None

    def _save(self, trainer: Trainer, events: RunEvents | None) -> None:
        self._saved = trainer.epoch
        if events is None:  # the first process saves
            return
        events.flush()  # first: a resumed run's curves start where the checkpoint is
        state = {"config": self._text, "logs": _fingerprint(trainer), "trainer": trainer.state_dict()}
        save_checkpoint(self.folder, state)

    def _check(self, state: Mapping[str, Any], trainer: Trainer) -> None:
        path = self.folder / CHECKPOINT
        if set(state) != {"config", "logs", "trainer"}:
            raise InputError(path, "file", "not a checkpoint of a run", "one that torchid identify wrote")
        before, now = (yaml.safe_load(text) for text in (state["config"], self._text))
        for key, old, new in _differences(before, now):
            if key not in _FREE_TO_CHANGE:
                raise ConfigError.at_field(key, f"{new}, but the checkpoint has {old}", "the same settings")
        rows, cost = _fingerprint(trainer)
        if state["logs"][0] != rows or abs(state["logs"][1] - cost) > _SAME * cost:
            raise ConfigError.at_field("logs", "not those of the checkpoint", "the same files, unchanged")

    @contextmanager
    def _interruptible(self, trainer: Trainer) -> Iterator[None]:
        try:
            yield
        except KeyboardInterrupt as error:
            stopped = f"interrupted in epoch {trainer.epoch}; --resume goes on after epoch {self._saved}"
            raise KeyboardInterrupt(stopped) from error
        except InputError:  # it would diverge again; the curves stay, to be looked at
            if ranks.is_first():
                (self.folder / CHECKPOINT).unlink(missing_ok=True)
            raise


def descent_settings(config: ExperimentConfig) -> Sgd:
    """What an experiment file says of a descent.

    Raises:
        InputError: an optimizer or schedule that torch does not have or that does not take its options.
    """
    settings = config.estimator.sgd
    try:
        settings.try_out()
    except InputError as error:
        raise ConfigError.at_field(f"estimator.training.{error.field}", error.found, error.accepted) from error
    return settings


def body_eigenvalues(robot: Robot, phi: Array) -> dict[str, float]:
    """Smallest eigenvalue of every body's scaled pseudo-inertia, by name, of parameters (12 L,)."""
    least = parameters.least_eigenvalues(phi, parameter_scale(robot.nominal).flatten())
    return {name: float(x) for name, x in zip(robot.body_names, least, strict=True) if x == x}


def _growing() -> tuple[str, ...]:
    """Patterns of what this process will write into the training's folder, event files by host and process."""
    return CHECKPOINT, f".{CHECKPOINT}", f"{EVENTS}.{glob.escape(socket.gethostname())}.{os.getpid()}.*"


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


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a state of plain types and tensors, under a temporary name first, with a digest of its values.

    Raises:
        OSError: names the file, if the disk is full or cannot be written.
    """
    temporary, path, content = folder / f".{CHECKPOINT}", folder / CHECKPOINT, io.BytesIO()
    torch.save(state | {_DIGEST: _digest(state)}, content)  # not to the file: torch hides why that cannot be written
    try:
        with temporary.open("wb") as file:
            file.write(content.getbuffer())
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
        InputError: the file is damaged, was changed by others than `save_checkpoint`, or is none of ours.
    """
    path = folder / CHECKPOINT
    with refusing_damage(folder):
        _check_archive(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pickles that are not torch's, which it then refuses
            state = torch.load(path, weights_only=True)
        _check_values(state)
    if not isinstance(state, dict):
        raise InputError(path, "file", f"holds a {type(state).__name__}", _ACCEPTED)
    if state.pop(_DIGEST, None) != _digest(state):
        raise InputError(path, "file", "not the values that were written, by their digest", _ACCEPTED)
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
        found = f"not readable ({excerpt(str(error) or type(error).__name__, 200)})"
        raise InputError(folder / CHECKPOINT, "file", found, _ACCEPTED) from error


def _digest(value: Any) -> str:
    """Of all values in a state, with their types and their order."""
    digest, left = hashlib.sha256(), [value]
    while left:
        value = left.pop()
        digest.update(type(value).__name__.encode())
        if isinstance(value, torch.Tensor):
            digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
            digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
        elif isinstance(value, dict):
            digest.update(f"{len(value)}".encode())
            left += [x for pair in value.items() for x in pair]
        elif isinstance(value, (list, tuple)):
            digest.update(f"{len(value)}".encode())
            left += value
        else:
            digest.update(f"{value!r};".encode())
    return digest.hexdigest()


def _check_archive(path: Path) -> None:
    """Compare what was written with its checksums, which `torch.load` does not look at; nothing may have to unfold."""
    check_regular(path)
    with zipfile.ZipFile(path) as file:
        entries = file.infolist()
        if len(entries) > MAX_STATE or any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise zipfile.BadZipFile("compressed, or of too many parts")
        if any(entry.filename.endswith("constants.pkl") for entry in entries):
            raise zipfile.BadZipFile("a programme of torch.jit")
        damaged = file.testzip()
    if damaged is not None:
        raise zipfile.BadZipFile(f"damaged in {damaged}")


def _check_values(state: object) -> None:
    """Refuse tensors that are larger than what is stored of them, settings that would unfold, and endless nesting."""
    left, count = [state], 0
    while left:
        value, count = left.pop(), count + 1
        if count > MAX_STATE:
            raise ValueError(f"more than {MAX_STATE} values")
        if isinstance(value, dict):
            left += [*value.keys(), *value.values()]
        elif isinstance(value, (list, tuple)):
            left += value
        elif isinstance(value, torch.Tensor) and not _is_stored(value):
            raise ValueError(f"a tensor of shape {tuple(value.shape)} that is not stored as such")
    if isinstance(state, dict) and isinstance(state.get("config"), str):
        check_yaml(state["config"])


def _is_stored(tensor: torch.Tensor) -> bool:
    """Whether every number of it is in the file."""
    size = tensor.numel() * tensor.element_size()
    return tensor.layout == torch.strided and not tensor.is_meta and size <= tensor.untyped_storage().nbytes()
