"""Command line: parse, call, print."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from torchid import __version__
from torchid.boundary import importing, open_closed_streams, plain_streams, run_distributed, run_guarded
from torchid.commands import EXPORT_FORMATS, SAMPLE_FORMATS
from torchid.distributed import end_process, is_launched_first, share_work
from torchid.errors import ConfigError, during
from torchid.parallel import forks_allowed

_IDENTIFY = "fit a robot to the logs of an experiment file and write a run folder"
_COMPRESS = "compress the training logs of an experiment file to small files that identify can fit instead"
_EVALUATE = "predict the forces of further logs with the parameters of a run"
_REPLAY = "drive the robot in MuJoCo with the torques of a log, and report its drift (extra [sim])"
_EXPORT = "write the identified parameters of a run for a simulator: MJCF, URDF, actuators of Isaac Lab, or JSON"
_SAMPLE = "draw robots within the uncertainty of a run, for domain randomization"
_REPORT = "write report.html of a run again, with the findings of the log checks"
_ANALYZE = "report what sensors and motion can determine, and find the smallest sensor set"
_INIT = "write an experiment file for a robot and a log; you fill in what is uncertain"
_DEMO = "identify the demo's quadruped, or copy the examples that ship with torchid"
_CONVERT = "write a log of any type as .npz, .h5, .csv or .parquet"
_CHECK = "find mistakes in logs, and say what to do"
_SIMULATE = "simulate a robot and write the logs of its sensors (extra [sim])"
_FIRST_STEPS = """first steps with a robot of your own:
  torchid init robot.urdf walk.csv --output robot.yaml
  torchid check robot.yaml
  torchid identify robot.yaml

torchid COMMAND --help lists the options of a command."""
_SHELLS = ("bash", "zsh")
_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
_SHARED = ("identify", "compress", "evaluate", "analyze")
"""Commands that torchrun processes share; the first process runs all others."""
_WITHOUT_LOGS = ("export", "simulate", "sample")


def run() -> NoReturn:
    """Run the command and end the process at once, as an orderly end takes 0.3 s."""
    open_closed_streams()
    end_process(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; 0 on success, 2 on bad input, 1 on anything else."""
    try:
        with forks_allowed() if arguments is None else nullcontext():
            return run_distributed("torchid", lambda: _main(arguments))
    finally:
        if arguments is not None:  # whoever calls it goes on
            gc.unfreeze()


def _main(arguments: Sequence[str] | None) -> int:
    with plain_streams():  # argparse repeats unknown arguments in its errors
        options = _options(arguments)
    answers = not (getattr(options, "verbose", True) or options.quiet)
    return run_guarded("torchid", lambda: _command(options), options.debug, answers)


def _command(options: argparse.Namespace) -> int | None:
    target = getattr(options, "file", getattr(options, "run", getattr(options, "source", "")))
    if options.name not in _SHARED and not is_launched_first():
        return 0
    if options.name not in _WITHOUT_LOGS:
        from torchid.reader import warm_up

        warm_up()  # while torch is imported
    with share_work() if options.name in _SHARED else nullcontext(), during(options.name, target):
        status: int | None = options.command(options)
        return status


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The parsed command line; overrides may also follow options, which argparse does not support."""
    parser = _parser()
    options, overrides = parser.parse_known_args(arguments)
    keys = [text.lstrip("-").partition("=")[0].replace("-", "_") for text in overrides if text.startswith("-")]
    has_settings = hasattr(options, "overrides")
    if keys or (overrides and not has_settings):
        accepted = f"; accepted: settings of the file as {keys[0]}=VALUE" if has_settings else ""
        parser.error(f"unrecognized arguments: {' '.join(overrides)}{accepted}")
    if overrides:
        options.overrides = [*options.overrides, *overrides]
    return options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchid",
        description="Identify a robot's inertia and friction from logs.",
        epilog=_FIRST_STEPS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"torchid {__version__}")
    what = "print a script that completes commands, options and files in this shell"
    parser.add_argument("--print-completion", action=_PrintCompletion, choices=_SHELLS, help=what)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in (_add_starts, _add_fits, _add_uses_of_runs, _add_studies, _add_work_on_logs):
        add(commands)
    for name, command in commands.choices.items():
        command.add_argument("--debug", action="store_true", help="show the traceback of an unexpected error")
        command.set_defaults(name=name)
    return parser


def _add_fits(commands: _Commands) -> None:
    """Commands that take an experiment file: before a fit, and the fit."""
    check = commands.add_parser("check", help=_CHECK, description=_CHECK)
    _add_file(check, "experiment file (YAML), or a log", "with an experiment file")
    check.add_argument("--urdf", metavar="FILE", help="robot of a log, URDF or MJCF; without it there are fewer checks")
    check.add_argument("--base-link", metavar="LINK", help="base of that robot, if it is not the URDF's root")
    check.add_argument("--fixed-base", action="store_true", help="the base of that robot is fixed")
    _add_maps(check)
    check.add_argument("--json", metavar="FILE", help="write all findings to a .json file")
    check.add_argument("--figure", metavar="FILE", help="write an overview of all channels (.png, .pdf or .svg)")
    check.add_argument("--overwrite", action="store_true", help="replace these two files if they exist")
    check.set_defaults(command=_check)
    identify = commands.add_parser("identify", help=_IDENTIFY, description=_IDENTIFY)
    _add_file(identify, "experiment file (YAML)", "for example estimator.ridge=0.01")
    identify.add_argument("--resume", action="store_true", help="continue an interrupted training (sgd)")
    identify.set_defaults(command=_identify)


def _add_uses_of_runs(commands: _Commands) -> None:
    """Commands that take the folder of a run."""
    evaluate = commands.add_parser("evaluate", help=_EVALUATE, description=_EVALUATE)
    evaluate.add_argument("run", help="run folder")
    evaluate.add_argument("--log", action="append", required=True, metavar="FILE", help="log; may be repeated")
    evaluate.add_argument("--output", metavar="FOLDER", help="folder to write (default: RUN/evaluation/LOG)")
    evaluate.add_argument("--overwrite", action="store_true", help="replace an earlier evaluation in this folder")
    evaluate.add_argument("--device", help="device, by default that of the run: cpu, cuda, cuda:0, ...")
    _add_amount(evaluate)
    evaluate.set_defaults(command=_evaluate)
    replay = commands.add_parser("replay", help=_REPLAY, description=_REPLAY)
    replay.add_argument("run", help="run folder")
    replay.add_argument("--log", required=True, metavar="FILE", help="log whose joint torques drive the robot")
    replay.add_argument("--window", type=float, default=0.5, metavar="S", help="length of a replay [s] (default: 0.5)")
    for option, what in (("--kp", "position"), ("--kd", "velocity")):
        text = f"{what} gains of the PD law behind the torques: 20, '*_calf=30' (default: 0)"
        replay.add_argument(option, nargs="+", default=[], metavar="GAIN", help=text)
    replay.add_argument("--samples", type=int, default=10, metavar="N", help="sampled robots to replay (default: 10)")
    replay.add_argument("--output", metavar="FOLDER", help="folder to write: a figure and all numbers")
    replay.add_argument("--overwrite", action="store_true", help="replace an earlier replay in this folder")
    _add_amount(replay)
    replay.set_defaults(command=_replay)
    export = commands.add_parser("export", help=_EXPORT, description=_EXPORT)
    export.add_argument("run", help="run folder")
    export.add_argument("--format", required=True, choices=EXPORT_FORMATS, help="what to write")
    export.add_argument("--output", metavar="FILE", help="file to write (default: standard output)")
    export.add_argument("--overwrite", action="store_true", help="replace this file if it exists")
    export.set_defaults(command=_export)
    _add_sample(commands)
    report = commands.add_parser("report", help=_REPORT, description=_REPORT)
    report.add_argument("run", help="run folder")
    report.set_defaults(command=_report)


def _add_sample(commands: _Commands) -> None:
    sample = commands.add_parser("sample", help=_SAMPLE, description=_SAMPLE)
    sample.add_argument("run", help="run folder")
    sample.add_argument("--count", type=int, metavar="N", help="number of samples (default: 10000; robot files: 20)")
    what = "named arrays, a robot file for each sample, or ranges and correlations (default: by --output)"
    sample.add_argument("--format", choices=SAMPLE_FORMATS, help=what)
    sample.add_argument("--output", metavar="FILE", help="FILE.npz, FILE.json, or a folder for robot files")
    prior = "relative error of each body in the robot's file; auto: estimated from the data (default: 0.2)"
    sample.add_argument("--prior-error", default="0.2", metavar="SHARE", help=prior)
    sample.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default: 0)")
    sample.add_argument("--overwrite", action="store_true", help="replace what exists there")
    _add_amount(sample)
    sample.set_defaults(command=_sample)


def _add_studies(commands: _Commands) -> None:
    """Commands that need no recorded log."""
    analyze = commands.add_parser("analyze", help=_ANALYZE, description=_ANALYZE)
    _add_file(analyze, "experiment file (YAML), also without logs", "for example analysis.candidates.contacts=axis")
    analyze.set_defaults(command=_analyze)
    simulate = commands.add_parser("simulate", help=_SIMULATE, description=_SIMULATE)
    _add_file(simulate, "simulation file (YAML)", "for example sensors.bias.enabled=true")
    simulate.set_defaults(command=_simulate)


def _add_maps(command: argparse.ArgumentParser) -> None:
    """Options that describe a foreign log."""
    command.add_argument("--topics", metavar="FILE", help="experiment file with logs.topics, the map of a bag's topics")
    command.add_argument("--columns", metavar="FILE", help="experiment file with logs.columns, a map of columns")


def _add_work_on_logs(commands: _Commands) -> None:
    """Commands that convert logs."""
    convert = commands.add_parser("convert", help=_CONVERT, description=_CONVERT)
    read = "log: .npz, .h5, .mat, .json, .csv, .txt, .parquet, .jsonl, .mot, .sto, or a bag of ROS messages"
    convert.add_argument("source", metavar="IN", help=read)
    convert.add_argument("target", metavar="OUT", help="file to write: .npz, .h5, .csv or .parquet")
    _add_maps(convert)
    convert.add_argument("--overwrite", action="store_true", help="replace OUT if it exists")
    convert.set_defaults(command=_convert)
    compress = commands.add_parser("compress", help=_COMPRESS, description=_COMPRESS)
    _add_file(compress, "experiment file (YAML)", "for example overwrite=true")
    compress.add_argument("--output", required=True, metavar="FOLDER", help="folder to write: a .factor file per log")
    compress.set_defaults(command=_compress)


def _add_starts(commands: _Commands) -> None:
    """First commands of a user."""
    demo = commands.add_parser("demo", help=_DEMO, description=_DEMO)
    demo.add_argument("overrides", nargs="*", default=[], help="key.subkey=value, as of identify")
    place = demo.add_mutually_exclusive_group()
    place.add_argument("--output", metavar="FOLDER", help="run folder to write (default: runs/quadruped)")
    place.add_argument("--copy", metavar="FOLDER", help="fit nothing; copy the examples to a new folder, to edit them")
    _add_amount(demo)
    demo.set_defaults(command=_demo)
    init = commands.add_parser("init", help=_INIT, description=_INIT)
    init.add_argument("urdf", metavar="ROBOT", help="the robot, a URDF or MJCF file")
    init.add_argument(
        "log",
        metavar="LOG",
        help="table, arrays or bag: .csv, .txt, .parquet, .jsonl, .mot, .sto, .npz, .h5, .mat, .json, .mcap, .db3, "
        ".bag; or several, 'FILE + FILE@SECONDS'",
    )
    what = "new file to write (default: experiment.yaml)"
    init.add_argument("--output", default="experiment.yaml", metavar="FILE", help=what)
    init.add_argument("--total-mass", type=float, metavar="KG", help="mass of the robot, if known from a scale")
    init.set_defaults(command=_init)


class _PrintCompletion(argparse.Action):
    """Prints a completion script for a shell, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *values: Any) -> None:
        """Whatever takes a value is completed by names of files, but for names in a robot, devices and settings."""
        import shtab

        (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
        for command in commands.choices.values():
            for action in command._actions:
                if action.dest not in ("overrides", "base_link", "device") and action.nargs != 0:
                    action.complete = shtab.DIRECTORY if action.metavar == "FOLDER" else shtab.FILE
        parser.exit(run_guarded("torchid", lambda: print(shtab.complete(parser, values[1]))))


def _add_file(command: argparse.ArgumentParser, what: str, example: str) -> None:
    command.add_argument("file", help=what)
    command.add_argument("overrides", nargs="*", default=[], help=f"key.subkey=value, {example}")
    _add_amount(command)


def _add_amount(command: argparse.ArgumentParser) -> None:
    amount = command.add_mutually_exclusive_group()
    amount.add_argument("--verbose", "-v", action="store_true", help="print all tables")
    amount.add_argument("--quiet", "-q", action="store_true", help="print nothing but warnings and errors")


def _show(options: argparse.Namespace, lines: Callable[[int], Iterable[Any]], details: Callable[[int], Any]) -> None:
    """Print what a command says for the terminal's width: nothing, the answer, or with `--verbose` all details."""
    from rich.table import Table

    from torchid.report.tables import print_tables, terminal_width

    parts = () if options.quiet else (details if options.verbose else lines)(terminal_width())
    for part in parts:
        print_tables(part) if isinstance(part, Table) else print(part)


def _identify(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.identify import identify
        from torchid.config import load_config
        from torchid.terminal.identification import answer_lines, detail_parts

    run = identify(load_config(options.file, options.overrides), options.resume)
    _show(options, partial(answer_lines, run), partial(detail_parts, run))


def _demo(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.demo import EXPERIMENT, copy_examples, run_demo
        from torchid.terminal.identification import answer_lines, detail_parts

    if options.copy is not None:
        if options.overrides:
            raise ConfigError("command line", "--copy", f"beside {options.overrides[0]}", "--copy FOLDER alone")
        folder = Path(options.copy)
        for file, what in copy_examples(folder).items():
            print(f"{file}\n    {what}")
        print(f"written to    {folder}; in the folder above it: torchid identify {folder.name}/{EXPERIMENT.name}")
        return
    run = run_demo(options.overrides, options.output)
    last = [("experiment", f"{EXPERIMENT}; to edit a copy: torchid demo --copy FOLDER")]
    _show(options, partial(answer_lines, run, last=last), partial(detail_parts, run, last=last))


def _compress(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.compress import compress
        from torchid.config import load_config
        from torchid.terminal.identification import compression_parts

    done = compress(load_config(options.file, options.overrides), options.output)
    _show(options, partial(compression_parts, done), partial(compression_parts, done, verbose=True))


def _evaluate(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.evaluate import evaluate
        from torchid.terminal.identification import evaluation_lines, evaluation_parts

    evaluated = evaluate(options.run, options.log, options.device, True, options.output, options.overwrite)
    _show(options, partial(evaluation_lines, evaluated), lambda _: evaluation_parts(evaluated))


def _replay(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.replay import parse_gains, replay
        from torchid.terminal.simulations import replay_lines

    gains = parse_gains("--kp", options.kp), parse_gains("--kd", options.kd)
    replayed = replay(
        options.run, options.log, options.window, options.output, options.overwrite, *gains, options.samples
    )
    _show(options, partial(replay_lines, replayed), partial(replay_lines, replayed, verbose=True))


def _sample(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.sample import parse_prior_error, sample
        from torchid.terminal.identification import sample_lines

    options.prior_error = parse_prior_error(options.prior_error)
    keys = ("run", "count", "format", "output", "prior_error", "seed", "overwrite")
    drawn = sample(*(getattr(options, key) for key in keys))
    _show(options, partial(sample_lines, drawn), partial(sample_lines, drawn, verbose=True))


def _export(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.export import export

    text = export(options.run, options.format, options.output, options.overwrite)
    print(f"written to    {options.output}" if options.output else text, end="\n" if options.output else "")


def _report(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.run_folder import report

    print(f"written to    {report(options.run)}")


def _analyze(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.analyze import analyze
        from torchid.config import load_analysis
        from torchid.terminal.analysis import analysis_lines, analysis_parts

    analysis = analyze(load_analysis(options.file, options.overrides))
    _show(options, partial(analysis_lines, analysis), partial(analysis_parts, analysis))


def _check(options: argparse.Namespace) -> int:
    with importing():
        from torchid.commands.check import check_files, check_outputs, write_check_outputs
        from torchid.terminal.analysis import check_lines, finding_parts

    inputs = (options.file, options.urdf, options.topics, options.columns)
    check_outputs(options.json, options.figure, options.overwrite, inputs)
    robot = {"urdf": options.urdf, "base_link": options.base_link, "fixed_base": options.fixed_base}
    checked = check_files(options.file, options.overrides, **robot, topics=options.topics, columns=options.columns)
    write_check_outputs(checked, options.json, options.figure)
    written = options.json, options.figure
    _show(options, partial(check_lines, checked, written), partial(finding_parts, checked, written))
    return 0 if all(log.usable for log in checked) else 1


def _init(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.init import init
        from torchid.report.tables import labelled, terminal_width

    for label, text in init(options.urdf, options.log, options.output, options.total_mass).lines:
        print("\n".join(labelled(label, text, terminal_width())))


def _convert(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.check import convert

    log = convert(options.source, options.target, options.topics, options.overwrite, options.columns)
    print(f"written to    {options.target}: {len(log)} samples, {', '.join(log.arrays())}")


def _simulate(options: argparse.Namespace) -> None:
    with importing():
        from torchid.commands.simulate import simulate
        from torchid.config import load_simulation
        from torchid.terminal.simulations import all_motion_lines, simulation_lines

    config = load_simulation(options.file, options.overrides)
    stabilities = simulate(config)
    _show(options, partial(simulation_lines, config, stabilities), partial(all_motion_lines, config, stabilities))
