"""Commands as functions, which return what they found and write nothing that is not asked for."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from torchid.commands.analyze import Analysis
from torchid.commands.analyze import analyze as analyze_settings
from torchid.commands.check import EXPERIMENTS, CheckedLogs, check_experiment, check_log
from torchid.commands.evaluate import EvaluatedRun, evaluate_identification
from torchid.commands.evaluate import evaluate as evaluate_folder
from torchid.commands.identify import identify as identify_settings
from torchid.commands.run_folder import Identification
from torchid.config import load_analysis, load_config
from torchid.config.settings_files import Sections, StrPath, plain_sections
from torchid.errors import ConfigError, UnknownNameError, about_file
from torchid.log_checks import Checked
from torchid.log_checks.check import check as check_samples
from torchid.logs import Log

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from torchid.robot import Robot
    from torchid.sensing import Contact


_FILES = {"urdf", "mjcf"}
_OF_LOG = _FILES | {"base_link", "fixed_base"}


def identify(file: StrPath | None = None, /, *, resume: bool = False, **sections: Unpack[Sections]) -> Identification:
    """Identify a robot's parameters, as `torchid identify` does.

    For example::

        result = torchid.identify("experiment.yaml")
        result = torchid.identify(robot="go2.urdf", logs=["walk.npz"], sensors="joints", contacts=[...])
        result["l_knee"].mass, result["l_knee"].standard_error.mass, result["l_knee"].verdict.mass

    Args:
        file: experiment file; None if the keywords contain everything.
        resume: continue an interrupted training.
        sections: keys of an experiment file with their values. They override those of the file. Paths are relative to
            the working directory. With an `output` a run folder is written; `output=None` writes nothing.

    Raises:
        InputError: an input is wrong; the message names the file, or the function without a file.
        BaseLostError: the sensors do not determine the motion of the base.
    """
    with _about("identify", file):
        return identify_settings(load_config(_path(file), (), sections), resume)


def evaluate(
    run: StrPath | Identification, logs: StrPath | Sequence[StrPath], device: str | None = None, write: bool = False
) -> EvaluatedRun:
    """Evaluate the parameters of a run on further logs, as `torchid evaluate` does.

    Args:
        run: result of `identify`, or its folder.
        logs: one or several logs, or parts of them: "walk.npz[30:]".
        device: where to compute; None for the device of the run.
        write: whether to write the results to RUN/evaluation too.

    Raises:
        InputError: the folder is not a run, or a log does not fit its robot.
    """
    paths = [Path(log) for log in ([logs] if isinstance(logs, (str, os.PathLike)) else logs)]
    with _about("evaluate", None):
        if isinstance(run, Identification):
            if not write:
                return evaluate_identification(run, paths, device)
            if run.experiment.config.output is None:
                raise ConfigError.at_field("write", "True, but the run has no folder", "run.write(folder) first")
            run = run.experiment.config.output
        return evaluate_folder(Path(run), paths, device, write)


def analyze(file: StrPath | None = None, /, **sections: Unpack[Sections]) -> Analysis:
    """Analyze what sensors and motion determine, and plan sensors, as `torchid analyze` does.

    Args:
        file: experiment file; None if the keywords contain everything. Logs and sensors are optional.
        sections: as for `identify`.

    Raises:
        InputError: an input is wrong.
    """
    with _about("analyze", file):
        return analyze_settings(load_analysis(_path(file), (), sections))


@overload
def check(
    what: Log,
    robot: Robot | None = None,
    contacts: Sequence[Contact] = (),
    cutoff_hz: float | None = None,
    derived: tuple[str, ...] = (),
) -> Checked: ...


@overload
def check(what: StrPath | None = None, **sections: Unpack[Sections]) -> CheckedLogs: ...


def check(what: Log | StrPath | None = None, *of_log: Any, **sections: Any) -> Checked | CheckedLogs:
    """Check logs for errors, as `torchid check` does.

    Args:
        what: an experiment file; a log file, alone or with `robot`; a `Log`; or None: keywords only.
        of_log: for a `Log`: robot, contacts, cutoff_hz and derived, see `torchid.log_checks.check.check`.
        sections: as for `identify`; for a log file only `robot`.

    Raises:
        InputError: a log that cannot be read, or invalid input.
    """
    if isinstance(what, Log):
        return check_samples(what, *of_log, **sections)
    if of_log:
        raise TypeError("check: only a Log takes positional robot and contacts; for files use keywords")
    with _about("check", what):
        if what is None or Path(what).suffix.lower() in EXPERIMENTS:
            return CheckedLogs(check_experiment(_path(what), (), sections))
        if other := sections.keys() - {"robot"}:
            raise UnknownNameError.at_field("key", min(other), ("robot",), "which needs an experiment file")
        robot = plain_sections(sections).get("robot", {})
        robot = {"urdf": robot} if isinstance(robot, str) else robot
        if not isinstance(robot, Mapping) or not robot.keys() <= _OF_LOG or (robot and len(_FILES & robot.keys()) != 1):
            accepted = "a URDF, or a mapping with urdf or mjcf, and base_link or fixed_base"
            raise ConfigError.at_field("robot", f"found {robot!r}", accepted)
        return CheckedLogs([check_log(Path(what), **{"urdf" if key == "mjcf" else key: x for key, x in robot.items()})])


@contextmanager
def _about(function: str, file: StrPath | None) -> Iterator[None]:
    """Let errors name the file, or the function without one."""
    with about_file(f"torchid.{function}" if file is None else file):
        yield


def _path(file: StrPath | None) -> Path | None:
    return None if file is None else Path(file)
