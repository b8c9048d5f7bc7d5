"""`torchid simulate`: from a simulation file to logs, in one process per core."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import numpy as np

from torchid import parameters
from torchid.commands.folder import SIMULATION, check_free, new_folder, write_json
from torchid.config import MotionConfig, NominalConfig, SimulationConfig, dump_config
from torchid.errors import about_file, current_file
from torchid.logs import write_log
from torchid.parameters import Array
from torchid.report import FittedJoints, identified_robot
from torchid.report.tables import progress_bars
from torchid.robot import Robot, load_robot
from torchid.simulation import LEAD_S, Stability, sensor_log, set_up_simulation
from torchid.simulation.plant import find_feet

_POLL_S = 0.2
START = "spawn"
"""How processes begin: forks would inherit threads, of which a command has some."""


def simulate(config: SimulationConfig) -> dict[str, Stability]:
    """Simulate all motions and write a folder: `logs/`, `exact/`, `nominal.urdf`, `stability.json`, `simulation.yaml`.

    Args:
        config: robot, feet, motions and imperfections.

    Returns:
        How the robot stood, by motion.

    Raises:
        InputError: whatever does not fit, or a robot that does not keep standing; nothing has been written then.
    """
    check_free(config.output, config.overwrite, SIMULATION, [config.robot.path])
    settings = config.robot
    robot = load_robot(
        settings.path, weld=settings.weld, loops=[loop.loop for loop in settings.loops], passive=settings.passive
    )
    simulation = set_up_simulation(config)
    for motion in config.motions:
        simulation.reference(motion)
    with new_folder(config.output, config.overwrite, SIMULATION) as folder, progress_bars() as bars:
        (folder / "logs").mkdir()
        (folder / "exact").mkdir()
        bar = bars.add_task("simulating [s]", total=sum(LEAD_S + motion.duration_s for motion in config.motions))
        stabilities = _in_processes(config, folder, lambda seconds: bars.update(bar, completed=seconds))
        (folder / "simulation.yaml").write_text(dump_config(config))
        write_json(folder / "stability.json", {name: asdict(stability) for name, stability in stabilities.items()})
        nominal = identified_robot(robot, perturbed_parameters(robot, config.nominal), FittedJoints())
        (folder / nominal_name(config)).write_bytes(nominal)
    return stabilities


def nominal_name(config: SimulationConfig) -> str:
    """Name of the file with the robot that an identification starts from."""
    return "nominal.urdf" if config.robot.mjcf is None else "nominal.xml"


def simulated_balls(config: SimulationConfig) -> str:
    """The feet that roll on one collision sphere of the URDF, with its radius, "" if none does."""
    feet = find_feet(config.feet, config.robot.path)
    rolling = [f"{foot.frame}: radius {foot.rolling_radius:g} m" for foot in feet if foot.rolling_radius]
    return ", ".join(rolling) + (" (collision spheres)" if rolling else "")


def perturbed_parameters(robot: Robot, settings: NominalConfig, draw: int = 0) -> Array:
    """Parameters (L, 12) that an identification starts from, off from those of the simulated robot."""
    return parameters.perturb_parameters(robot.nominal, settings.error, np.random.default_rng([settings.seed, draw]))


def _in_processes(config: SimulationConfig, folder: Path, progress: Callable[[float], None]) -> dict[str, Stability]:
    """Simulate every motion, the longest first; `progress` gets the seconds simulated so far."""
    context = multiprocessing.get_context(START)
    done = context.Value("d", 0.0)
    workers = min(os.cpu_count() or 1, len(config.motions))
    pool = ProcessPoolExecutor(workers, context, _start_worker, (done,))
    try:
        ordered = sorted(config.motions, key=lambda motion: -motion.duration_s)
        tasks = {
            motion.name: pool.submit(_simulate_motion, config, motion, folder, current_file()) for motion in ordered
        }
        waiting = set(tasks.values())
        while waiting:
            finished, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
            for task in finished:
                task.result()  # raises what went wrong, at once
            progress(done.value)
        return {motion.name: tasks[motion.name].result() for motion in config.motions}
    finally:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(cancel_futures=True)


_done: Synchronized[float]


def _start_worker(done: Synchronized[float]) -> None:
    global _done
    _done = done
    for name in ("SIGINT", "SIGHUP"):  # they are for the parent, which ends its workers
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End a worker whose parent was killed: it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _simulate_motion(config: SimulationConfig, motion: MotionConfig, folder: Path, file: str) -> Stability:
    """Simulate one motion of a file in a worker, which does not know of `about_file`, and write its two logs."""

    def progress(seconds: float) -> None:
        with _done.get_lock():
            _done.value += seconds

    with about_file(file):
        recording, stability = set_up_simulation(config).run(motion, progress)
    write_log(recording.log, folder / "exact" / f"{motion.name}.npz")
    log = sensor_log(recording.log, config.sensors, config.seed)
    write_log(log, folder / "logs" / f"{motion.name}.npz")
    return stability
