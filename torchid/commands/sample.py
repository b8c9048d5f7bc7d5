"""`torchid sample`: parameter sets from the posterior of a run."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from torchid.commands import SAMPLE_FORMATS
from torchid.commands.evaluate import read_run, require_run
from torchid.commands.export import robot_text
from torchid.commands.folder import SAMPLES, check_free, check_free_file, new_folder
from torchid.errors import ConfigError, TorchidWarning, during, excerpt
from torchid.estimators.posterior import PRIOR_ERROR
from torchid.fitting.posterior import FittedPosterior, ParameterSamples, PosteriorSampler, read_posterior
from torchid.logs.containers import save_arrays
from torchid.report import FittedJoints
from torchid.report.parameter_files import ranges_document, sample_arrays
from torchid.report.robot_files import IN_FILES
from torchid.reprs import short_repr
from torchid.staging import atomic_file

ROBOTS = ("urdf", "mjcf")
"""Formats with a file for each sample."""

COUNT = 10_000
COUNT_OF_ROBOTS = 20
MOST = 200_000
MOST_ROBOTS = 10_000
"""Samples at most: of a humanoid, 0.6 GB; files of robots in one folder."""

_WIDTHS = "a number above 0, at most 100, or auto"
_BY_SUFFIX = {".npz": "npz", ".json": "ranges"}


@dataclass(frozen=True, kw_only=True)
class DrawnSamples:
    """Samples of a run's posterior.

    Attributes:
        fitted: the posterior.
        samples: of it.
        prior_error: standard deviation of the nominal parameters, as a share of each body.
        seed: of the random numbers.
        output: the file or folder that they were written to, if any.
    """

    fitted: FittedPosterior
    samples: ParameterSamples
    prior_error: float
    seed: int
    output: Path | None = None

    __repr__ = short_repr

    @property
    def about(self) -> dict[str, float]:
        """Numbers that say how they were drawn."""
        return {"prior_error": self.prior_error, "seed": self.seed}


def sample(
    run: str | Path,
    count: int | None = None,
    form: str | None = None,
    output: str | Path | None = None,
    prior_error: float | Literal["auto"] = PRIOR_ERROR,
    seed: int = 0,
    overwrite: bool = False,
) -> DrawnSamples:
    """Draw parameter sets from the posterior of a run, each within all conditions, and write them.

    Args:
        run: folder that `identify` wrote.
        count: of sets; None: `COUNT`, or `COUNT_OF_ROBOTS` where each has a file.
        form: one of `SAMPLE_FORMATS`: "npz", arrays with names; "urdf", "mjcf": a folder with a robot for each set;
            "ranges": quantiles of each parameter and their correlations, JSON. None: as `output` says by its extension.
        output: file or folder to write; None: nothing is.
        prior_error: standard deviation of the nominal parameters, as a share of each body, or "auto", as the data say
            where they contradict the default.
        seed: of the random numbers.
        overwrite: whether what stands there may be replaced.

    Raises:
        InputError: the folder is no run, or of an older version; a number out of range; a place that cannot be written.
    """
    folder = Path(run)
    out = None if output is None else Path(output)
    form = _form(form, out)
    count = _count(count, form)
    if prior_error != "auto" and not 0.0 < prior_error <= 100.0:
        raise ConfigError("command line", "--prior-error", f"{prior_error:g}", _WIDTHS)
    if not 0 <= seed < 2**63:
        raise ConfigError("command line", "--seed", f"{seed}", "a whole number of at least 0")
    require_run(folder)
    if out is not None and form in ROBOTS:
        check_free(out, overwrite, SAMPLES, [folder])
    elif out is not None:
        check_free_file(out, "--output", overwrite, [folder])
    fitted = read_posterior(folder)
    prior_error = fitted.prior_error(prior_error)
    samples = PosteriorSampler(fitted, prior_error).sample(count, torch.Generator().manual_seed(seed))
    drawn = DrawnSamples(fitted=fitted, samples=samples, prior_error=float(prior_error), seed=seed, output=out)
    if out is not None:
        with during("writing", out):
            _write(drawn, form, folder, out, overwrite)
    return drawn


def parse_prior_error(text: str) -> float | Literal["auto"]:
    """A prior's width of the command line. Raises ConfigError: neither a number nor auto."""
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError as error:
        raise ConfigError("command line", "--prior-error", f"'{excerpt(text)}'", _WIDTHS) from error


def _form(form: str | None, out: Path | None) -> str:
    """The format, from the extension of the output where it is not given."""
    if form is not None and form not in SAMPLE_FORMATS:
        raise ConfigError("command line", "--format", f"'{form}'", ", ".join(SAMPLE_FORMATS))
    by_suffix = None if out is None else _BY_SUFFIX.get(out.suffix.lower())
    if out is not None and form is None and by_suffix is None:
        reason = f"'{out.name}' has no known extension"
        raise ConfigError("command line", "--output", reason, f"FILE.npz, FILE.json, or --format {' or '.join(ROBOTS)}")
    if form == "npz" and out is not None and by_suffix != "npz":
        raise ConfigError("command line", "--output", f"'{out.name}'", "FILE.npz, with --format npz")
    return form or by_suffix or "ranges"


def _count(count: int | None, form: str) -> int:
    most = MOST_ROBOTS if form in ROBOTS else MOST
    if count is None:
        return COUNT_OF_ROBOTS if form in ROBOTS else COUNT
    if not 1 <= count <= most:
        raise ConfigError("command line", "--count", f"{count}", f"1 to {most}")
    return count


def _write(drawn: DrawnSamples, form: str, run: Path, out: Path, overwrite: bool) -> None:
    if form == "npz":
        save_arrays(out, sample_arrays(drawn.fitted, drawn.samples, drawn.about))
    elif form == "ranges":
        document = ranges_document(drawn.fitted, drawn.samples, drawn.about)
        with atomic_file(out) as new:
            new.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    else:
        with new_folder(out, overwrite, SAMPLES) as folder:
            for name, text in _robots(drawn.samples, form, run):
                (folder / name).write_text(text, encoding="utf-8")


def _robots(samples: ParameterSamples, form: str, run: Path) -> Iterable[tuple[str, str]]:
    """Names and texts of files of robots; what a format cannot say is warned of once."""
    robot = read_run(run).experiment.robot
    drawn = {what: samples.of_joints(what) for what in IN_FILES}
    digits = len(str(len(samples) - 1))
    suffix = {"urdf": ".urdf", "mjcf": ".xml"}[form]
    for number, phi in enumerate(samples.phi.cpu().numpy()):
        joints = {what: {name: float(x[number]) for name, x in values.items()} for what, values in drawn.items()}
        fitted = FittedJoints(**joints)  # type: ignore[arg-type]
        with warnings.catch_warnings():
            if number:
                warnings.simplefilter("ignore", TorchidWarning)
            text = robot_text(form, robot, phi, fitted, run)
        yield f"{robot.path.stem}_{number:0{digits}d}{suffix}", text
