"""Train small networks beside the rigid bodies, for forces that rigid bodies and friction do not explain.

    python scripts/train_residual.py                                     # on the log that comes with torchid
    python scripts/train_residual.py my.yaml estimator.friction=false    # another log; friction is left to the networks
    python scripts/train_residual.py --output runs/learned               # a run folder with the networks, and then
    torchid evaluate runs/learned --log other.npz
    python scripts/train_residual.py --device cuda                       # on a GPU

The logs under `test` are evaluated at the end only. Curves go to a new folder: `tensorboard --logdir runs/residual`.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

import torchid
from torchid import JointNetworks, RigidPlusResidual
from torchid.boundary import run_guarded
from torchid.commands.chosen_settings import with_chosen_settings
from torchid.commands.identify import identify
from torchid.commands.run_folder import hyperparameters
from torchid.config import load_config
from torchid.errors import ConfigError, about_file
from torchid.estimators import Sgd, Trainer
from torchid.fitting.experiment import set_up
from torchid.problem import MiniBatches
from torchid.reading.log_reader import LogReader
from torchid.report.tables import progress_bars
from torchid.report.tensorboard import RunEvents

DEMO = Path(torchid.__file__).parent / "demo" / "quadruped.yaml"


def main() -> int:
    """Train without and with the networks, and print their effect."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", default=DEMO, help="experiment file")
    parser.add_argument("overrides", nargs="*", help="key.subkey=value")
    parser.add_argument("--epochs", type=int, default=100, help="passes over the training logs")
    parser.add_argument("--weight", type=float, default=0.1, help="of the networks' force in the loss")
    parser.add_argument("--curves", type=Path, default=Path("runs/residual"), help="new folder for TensorBoard")
    parser.add_argument("--output", type=Path, help="new folder for the fit with the networks beside it")
    parser.add_argument("--device", help="where to compute, by default what the file says: cpu, cuda, cuda:0, ...")
    options = parser.parse_args()
    return run_guarded("train_residual", lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """Train twice on the same batches, without and with the networks."""
    if os.path.lexists(options.curves) and not (options.curves.is_dir() and not any(options.curves.iterdir())):
        raise ConfigError("command line", "--curves", f"{options.curves} exists", "a new folder")
    config = load_config(options.file, [*options.overrides, *([f"device={options.device}"] if options.device else [])])
    with about_file(options.file):
        if not config.logs.test:
            raise ConfigError.at_field("logs.test", "none", "logs to evaluate the networks on")
        with progress_bars() as bars:
            experiment, _ = with_chosen_settings(set_up(config), bars)
    config = experiment.config
    robot, builder = experiment.robot, experiment.builder(experiment.sensors)
    reader = LogReader(experiment)
    train, test = (reader.read(paths, experiment.sensors) for paths in (config.logs.train, config.logs.test))
    train = [replace(log, motion_noise=None) for log in train]  # a descent sees samples as they are
    problem = torchid.linear_problem(torchid.compress(train, builder), builder, robot, config.estimator.friction)
    settings = Sgd(
        ridge=config.estimator.numeric_ridge, epochs=options.epochs, residual_lr=0.01, residual_weight=options.weight
    )
    torch.manual_seed(0)
    table = Table(title="rms of the projected residual, in standard deviations of the stated sensor noise")
    for name in ("", "training logs", "unseen logs", "share of rigid bodies", "share of networks"):
        table.add_column(name, justify="right" if name else "left")
    beside = JointNetworks(robot.n).to(config.device)
    for name, networks in (("rigid bodies alone", None), ("with networks", beside)):
        trainer = Trainer(settings, problem, MiniBatches(train, builder), residual=networks)
        with RunEvents(options.curves / name.replace(" ", "_")) as events:
            for _ in track(range(options.epochs), description=name):
                epoch = trainer.run_epoch()
                events.write_epoch(epoch, trainer.loss.mean_square(MiniBatches(test, builder)))
            seen, unseen = (trainer.loss.mean_square(MiniBatches(logs, builder)) ** 0.5 for logs in (train, test))
            used = {**hyperparameters(config), "estimator": f"sgd, {name}", "training.epochs": options.epochs}
            weight = {"training.residual_weight": options.weight if networks else 0.0}
            events.write_hyperparameters(used | weight, ["loss_unseen/data", "loss/data"])
        shares = (f"{100.0 * epoch.shares.get(of, 0.0):.3g} %" for of in ("rigid_body", "residual"))
        table.add_row(name, f"{seen:.3f}", f"{unseen:.3f}", *shares)
    Console(width=100).print(table)
    estimate = trainer.estimate()
    if estimate.residual is not None:
        for name, share in estimate.residual.shares.items():
            rms = estimate.residual.rms[name]
            print(f"{name.replace('_', ' ')}: the networks give {100.0 * share:.3g} %, rms {rms:.3g}")
    if options.output is not None:
        learned = RigidPlusResidual(robot, estimate.phi, beside.cpu())
        identify(replace(config, output=None)).write(options.output, learned=learned)
        print(f"written to {options.output}: torchid evaluate takes the networks up")


if __name__ == "__main__":
    raise SystemExit(main())
