"""Time the regressor and the whole pipeline against a per-sample pipeline of Pinocchio and NumPy, in one run.

    python scripts/benchmark.py [--samples 262144] [--repeats 5] [--device cuda]

Needs the packages pin and example-robot-data (extra `[oracle]`). Pipelines start from the arrays of a log and end with
parameters. Sensors are `joints` (torques measured, contact forces not); all feet are in contact in two thirds of the
samples. With `--device cuda` torchid's part runs on a GPU, the per-sample pipelines on the CPU as ever. A second table
has the modules for training loops (`scripts/modules.py`), a third the stages of the compression beside their floors
(`scripts/stages.py`).
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import torch
from markdown_table import Rows, print_table
from modules import ROWS, ModuleCase, Work, on_threads
from rich.console import Console
from stages import Limits, measure_stages, stage_table, synchronize
from threadpoolctl import ThreadpoolController

from torchid.errors import TorchidWarning, how_to_install
from torchid.estimators import Consistent, LeastSquares
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.motion import BaseMotion
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact, SensorNoise, named_sensors

_CPU = torch.device("cpu")
_PAUSE = 0.1  # seconds before each time that is taken: OpenBLAS' threads spin for some 30 ms after their last product
_STAGED = 65536  # samples whose stages are timed
_FEW = 2048  # samples that the per-sample pipelines are timed with


@dataclass(frozen=True)
class Case:
    """A robot with its feet."""

    name: str
    urdf: str
    feet: tuple[str, ...]
    kind: str


CASES = (
    Case("Solo12", "solo_description/robots/solo12.urdf", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), "point"),
    Case(
        "Alexander legs",
        "alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf",
        ("LEFT_FOOT", "RIGHT_FOOT"),
        "flat",
    ),
    Case("G1", "g1_description/urdf/g1_29dof_rev_1_0.urdf", ("left_ankle_roll_link", "right_ankle_roll_link"), "flat"),
)


def robots_folder() -> Path:
    """Where the package example-robot-data keeps its URDFs."""
    for folder in Path(pin.__file__).resolve().parents:
        robots = folder / "share" / "example-robot-data" / "robots"
        if robots.is_dir():
            return robots
    raise SystemExit(f"benchmark: the package example-robot-data is missing; {how_to_install('oracle')}")


def random_samples(robot: Robot, contacts: int, count: int) -> Samples:
    """Unrelated random states: the cost does not depend on the motion."""
    rng = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    active = torch.ones(count, contacts, dtype=torch.bool)
    active[2 * count // 3 :, 0] = False
    base = BaseMotion(torch.nn.functional.normalize(normal(count, 4)), *(normal(count, 3) for _ in range(3)))
    position, velocity, acceleration, torque = (normal(count, robot.n) for _ in range(4))
    time_stamps = torch.arange(count, dtype=torch.float64)
    return Samples("random", time_stamps, position, velocity, acceleration, base, torque, None, False, active)


@dataclass(frozen=True)
class Bench:
    """A robot with random samples, and the builder of its rows."""

    robot: Robot
    builder: RowBuilder
    samples: Samples

    @classmethod
    def of(cls, case: Case, count: int, device: torch.device = _CPU, noise: SensorNoise | None = None) -> Bench:
        """With so many samples, on the CPU."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)
            robot = load_robot(robots_folder() / case.urdf)
        contacts = [Contact(foot, case.kind) for foot in case.feet]
        sensors = named_sensors("joints", robot.n, len(contacts), noise)
        builder = RowBuilder(robot, contacts, sensors).to(device)
        return cls(robot, builder, random_samples(robot, len(contacts), count))

    def fit(self, estimator: LeastSquares | Consistent | None = None) -> None:
        """From arrays to parameters."""
        problem = linear_problem(compress([self.samples], self.builder), self.builder, self.robot)
        (estimator or LeastSquares()).solve(problem)


class PerSample:
    """Reference pipeline: one sample at a time with Pinocchio's regressor and NumPy's decompositions."""

    def __init__(self, urdf: Path, robot: Robot, case: Case) -> None:
        """Load the model and look up joints and feet."""
        self.model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        joints = [self.model.joints[self.model.getJointId(name)] for name in robot.joint_names]
        self.q_index = np.array([joint.idx_q for joint in joints])
        self.v_index = np.array([joint.idx_v for joint in joints])
        self.feet = [self.model.getFrameId(foot, pin.FrameType.BODY) for foot in case.feet]
        self.rows = 3 if case.kind == "point" else 6
        noise = SensorNoise()
        self.variance = np.append(noise.base_std, np.full(robot.n, noise.joint_torque)) ** 2

    def states(self, samples: Samples) -> tuple[Array, Array, Array, Array]:
        """q, v, a and torques in Pinocchio's order."""
        count, model = len(samples), self.model
        q, v, a, f = (np.zeros((count, size)) for size in (model.nq, model.nv, model.nv, model.nv))
        base_q, base_v, base_a = (x.numpy() for x in samples.coordinates())
        q[:, 3:7] = base_q[:, 3:7]
        q[:, self.q_index] = samples.joint_position
        v[:, :6] = base_v[:, :6]
        v[:, self.v_index] = samples.joint_velocity
        a[:, :6] = base_a[:, :6]
        a[:, self.v_index] = samples.joint_acceleration
        f[:, self.v_index] = samples.torque
        return q, v, a, f

    def projected(self, q: Array, v: Array, a: Array, f: Array, active: Array) -> tuple[Array, Array]:
        """V^T [K, friction] and V^T f of one sample, whitened; the same rows, up to a rotation, as torchid's."""
        K = pin.computeJointTorqueRegressor(self.model, self.data, q, v, a)
        feet = [foot for foot, touches in zip(self.feet, active, strict=True) if touches]
        J = np.vstack(
            [pin.computeFrameJacobian(self.model, self.data, q, foot, pin.LOCAL)[: self.rows] for foot in feet]
        )
        _, singular, Vh = np.linalg.svd(J)
        V = Vh[(singular > 1e-9 * singular[0]).sum() :]
        L = np.linalg.cholesky((V * self.variance) @ V.T)
        V = np.linalg.solve(L, V)
        friction = np.hstack([V[:, 6:] * np.sign(v[6:]), V[:, 6:] * v[6:]])
        return np.hstack([V @ K, friction]), V @ f

    def by_stack(self, samples: Samples) -> Array:
        """All rows stacked, one `numpy.linalg.lstsq`."""
        q, v, a, f = self.states(samples)
        blocks = [self.projected(*x) for x in zip(q, v, a, f, samples.active.numpy(), strict=True)]
        return np.linalg.lstsq(np.vstack([b[0] for b in blocks]), np.concatenate([b[1] for b in blocks]), rcond=None)[0]

    def by_gram(self, samples: Samples) -> Array:
        """Normal equations summed sample by sample (loses half of the digits)."""
        q, v, a, f = self.states(samples)
        columns = 10 * (self.model.njoints - 1) + 2 * (self.model.nv - 6)
        gram, right = np.zeros((columns, columns)), np.zeros(columns)
        for x in zip(q, v, a, f, samples.active.numpy(), strict=True):
            Y, y = self.projected(*x)
            gram += Y.T @ Y
            right += Y.T @ y
        return np.linalg.lstsq(gram, right, rcond=None)[0]

    def regressors(self, samples: Samples) -> None:
        """Only the regressor, called from Python."""
        q, v, a, _ = self.states(samples)
        for x in zip(q, v, a, strict=True):
            pin.computeJointTorqueRegressor(self.model, self.data, *x)


def medians(
    pipelines: Mapping[str, tuple[Callable[[], object], int]], repeats: int, device: torch.device = _CPU
) -> dict[str, float]:
    """Median microseconds per sample; the pipelines take turns, so that other load affects all alike.

    Each waits until the threads of the one before sleep, which would take a core from it.
    """
    times: dict[str, list[float]] = {name: [] for name in pipelines}
    for work, _ in pipelines.values():
        work()
    for _ in range(repeats):
        for name, (work, size) in pipelines.items():
            time.sleep(_PAUSE)
            times[name].append(microseconds(work, size, device))
    return {name: statistics.median(values) for name, values in times.items()}


def microseconds(work: Callable[[], object], samples: int, device: torch.device) -> float:
    """Wall time per sample of one call, until a GPU has done what it was given."""
    synchronize(device)
    start = time.perf_counter()
    work()
    synchronize(device)
    return (time.perf_counter() - start) / samples * 1e6


def measure(case: Case, count: int, repeats: int, device: torch.device) -> dict[str, float]:
    """Medians of microseconds per sample of one robot."""
    bench = Bench.of(case, count, device)
    per_sample = PerSample(robots_folder() / case.urdf, bench.robot, case)
    few = bench.samples[torch.arange(0, count, max(1, count // _FEW))]

    pipelines: dict[str, tuple[Callable[[], object], int]] = {
        "regressor alone, Pinocchio": (lambda: per_sample.regressors(few), len(few)),
        "`lstsq`, Pinocchio and NumPy sample by sample": (lambda: per_sample.by_stack(few), len(few)),
        "torchid, one thread": (on_threads(1, bench.fit), count),
        "torchid": (bench.fit, count),
    }
    return medians(pipelines, repeats, device)


def speed_table(count: int = 262_144, repeats: int = 5, device: torch.device = _CPU) -> Rows:
    """Microseconds per sample of whole fits."""
    measured = [measure(case, count, repeats, device) for case in CASES]
    yield "", *(case.name for case in CASES)
    for name in measured[0]:
        yield name, *(f"{times[name]:.1f}" for times in measured)


def modules_table(repeats: int = 15) -> Rows:
    """Times of the modules on one thread, as shares of those of Pinocchio and NumPy in a Python loop."""
    cases = [case for case in CASES if case.name != "Alexander legs"]
    works = dict[str, Work]()
    for case in cases:
        urdf = robots_folder() / case.urdf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)
            robot = load_robot(urdf)
        timed = ModuleCase(robot, str(urdf), case.feet, 3 if case.kind == "point" else 6)
        works |= {f"{case.name} {name}": repeated(*work) for name, work in timed.works().items()}
    with ThreadpoolController().limit(limits=1):
        measured = medians(works, repeats)
    yield "", *(case.name for case in cases)
    for title, peer, name in ROWS:
        shares = (measured[f"{case.name} {name}"] / measured[f"{case.name} {peer}"] for case in cases)
        yield title, *(f"{share:.2f}" for share in shares)


def repeated(work: Callable[[], object], samples: int) -> Work:
    """Calls for 8192 samples at least: after a pause, the first finds no data in the caches."""
    calls = max(1, 8192 // samples)

    def run() -> None:
        for _ in range(calls):
            work()

    return on_threads(1, run), samples * calls


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=262_144)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", type=torch.device, default=_CPU, help="cpu or cuda")
    arguments = parser.parse_args()
    device = arguments.device
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SystemExit("benchmark: --device: found no GPU that torch can use; accepted: cpu, or a machine with one")
    print_table(speed_table(arguments.samples, arguments.repeats, device))
    if device.type == "cpu":
        print_table(modules_table(3 * arguments.repeats))
    limits = Limits.of(device)
    benches = {case.name: Bench.of(case, _STAGED, device) for case in CASES}
    stages = {name: measure_stages(bench.builder, bench.samples, limits) for name, bench in benches.items()}
    Console(width=100).print(stage_table(stages, limits, device))


if __name__ == "__main__":
    main()
