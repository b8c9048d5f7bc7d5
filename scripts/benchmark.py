"""Time the regressor and the whole pipeline against a per-sample pipeline of Pinocchio and NumPy, in one run.

    python scripts/benchmark.py [--samples 262144] [--repeats 5] [--device cuda]

Needs the packages pin and example-robot-data (extra `[oracle]`). Pipelines
start from the arrays of a log and end with parameters. Sensors are `joints` (torques measured, contact forces not); all
feet are in contact in two thirds of the samples. Consistent parameters are timed on noisy data of Solo12 that were
generated with other, physically consistent parameters.

The modules for training loops are timed on one thread beside Pinocchio and NumPy called sample by sample, see
`scripts/modules.py`. With `--device cuda` torchid's part of the fits runs on a GPU, the per-sample pipelines on the CPU
as ever. A second table has the
stages of the compression beside their floors, see `scripts/stages.py`.
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import torch
from modules import ModuleCase, module_rows
from rich.console import Console
from rich.table import Table
from stages import Limits, Stages, measure_stages, stage_table, synchronize
from threadpoolctl import ThreadpoolController

from torchid.errors import TorchidWarning, how_to_install
from torchid.estimators import Consistent, LeastSquares
from torchid.parameters import FRICTION, Array, perturb_parameters
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.problem.motion import BaseMotion
from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact, SensorNoise, named_sensors

_CPU = torch.device("cpu")
_PAUSE = 0.1  # seconds before each time that is taken: OpenBLAS' threads spin for some 30 ms after their last product
_STAGED = 65536  # samples whose stages are timed
_DENSE = 16384  # samples whose whole regressor a GPU has at a time: 1.7 GB of G1
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


def torques_of(robot: Robot, case: Case, samples: Samples, phi: Array, noise: float) -> Samples:
    """The same motion with noisy torques [N m] of a robot with parameters (12 L,) and unmeasured foot forces."""
    regressor, feet = Regressor(robot), [FrameJacobian(robot, foot) for foot in case.feet]
    rows = 3 if case.kind == "point" else 6
    rng, torques = torch.Generator().manual_seed(1), []
    for start in range(0, len(samples), 1024):
        part = samples[start : start + 1024]
        q, v, a = part.coordinates()
        generalized = regressor(q, v, a) @ torch.from_numpy(phi)
        J = torch.cat([foot(q)[:, :rows] for foot in feet], dim=1)
        J = J * part.active.repeat_interleave(rows, dim=1)[..., None]
        contact = (torch.linalg.pinv(J[:, :, :6].mT) @ generalized[:, :6, None]).mT @ J
        torques.append(generalized[:, 6:] - contact[:, 0, 6:])
    exact = torch.cat(torques)
    noisy = exact + noise * torch.randn(exact.shape, generator=rng, dtype=exact.dtype)
    return replace(samples, torque=noisy)


def measure_consistent(count: int, repeats: int, device: torch.device) -> dict[str, float]:
    """Median seconds from the arrays of a log of Solo12 to parameters."""
    case, noise = CASES[0], 0.1
    bench = Bench.of(case, count, device, SensorNoise(noise))
    phi = perturb_parameters(bench.robot.nominal, 0.2, np.random.default_rng(0))
    phi[1:, FRICTION] = 0.1
    bench = replace(bench, samples=torques_of(bench.robot, case, bench.samples, phi.flatten(), noise))
    estimators: dict[str, LeastSquares | Consistent] = {
        "least squares": LeastSquares(1e-4),
        "consistent": Consistent(1e-4),
    }
    pipelines = {name: (partial(bench.fit, estimator), 10**6) for name, estimator in estimators.items()}
    return medians(pipelines, repeats, device)


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


def blas_kernels() -> str:
    """Library of linear algebra, and the processor whose kernels it has chosen."""
    libraries = ThreadpoolController().select(user_api="blas").info()
    names = {f"{x['internal_api']} {x['version']}, {x.get('architecture', 'unknown')} kernels" for x in libraries}
    return "; ".join(sorted(names)) or "unknown"


def measure(
    case: Case, count: int, repeats: int, device: torch.device, limits: Limits
) -> tuple[dict[str, float], Stages]:
    """Medians of microseconds per sample of one robot, and its stages."""
    bench = Bench.of(case, count, device)
    robot, builder, samples = bench.robot, bench.builder, bench.samples
    per_sample = PerSample(robots_folder() / case.urdf, robot, case)
    regressor = Regressor(robot).to(device)
    step = 1024 if device.type == "cpu" else _DENSE
    some = samples[: min(count, _STAGED)].to(device)
    few = samples[torch.arange(0, count, max(1, count // _FEW))]

    def in_chunks(work: Callable[[Samples], object]) -> Callable[[], None]:
        def run() -> None:
            with torch.inference_mode():
                for start in range(0, len(some), step):
                    work(some[start : start + step])

        return run

    pipelines: dict[str, tuple[Callable[[], object], int]] = {
        "K, Pinocchio": (lambda: per_sample.regressors(few), len(few)),
        "K, torchid, 12 L columns": (in_chunks(lambda part: regressor.from_motion(part.motion())), len(some)),
        "wrench columns, torchid": (in_chunks(builder.dynamics), len(some)),
        "per sample, lstsq": (lambda: per_sample.by_stack(few), len(few)),
        "per sample, Gram": (lambda: per_sample.by_gram(few), len(few)),
        "torchid": (bench.fit, count),
    }
    measured, by_stages = medians(pipelines, repeats, device), samples[torch.arange(0, count, max(1, count // _STAGED))]
    return measured, measure_stages(builder, by_stages, limits)


def module_table(repeats: int) -> Table:
    """Times of the modules of two robots and their shares of the peers'; calls of small batches are repeated."""
    names = [case for case in CASES if case.name != "Alexander legs"]
    works = dict[str, tuple[Callable[[], object], int]]()
    for case in names:
        urdf = robots_folder() / case.urdf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)
            timed = ModuleCase(load_robot(urdf), str(urdf), case.feet, 3 if case.kind == "point" else 6)
        for name, (work, samples) in timed.works().items():
            calls = max(1, 256 // samples)
            works[f"{case.name} {name}"] = partial(repeat, work, calls), samples * calls
    measured = medians(works, repeats)
    table = Table(title="Modules on one thread: microseconds per sample, and share of Pinocchio's or NumPy's time")
    for column in ("", *(case.name for case in names), "bar"):
        table.add_column(column, justify="right" if column else "left")
    rows = [module_rows({name: measured[f"{case.name} {name}"] for name in timed.works()}) for case in names]
    for of_robots in zip(*rows, strict=True):
        (title, _, _, bar) = of_robots[0]
        table.add_row(title, *(f"{time:.3g}; {share:.2f}" for _, time, share, _ in of_robots), f"{bar}")
    return table


def repeat(work: Callable[[], object], calls: int) -> None:
    """Call something often."""
    for _ in range(calls):
        work()


def main() -> None:
    """Measure all robots and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=262_144)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", type=torch.device, default=_CPU, help="cpu or cuda")
    arguments = parser.parse_args()
    device = arguments.device
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SystemExit("benchmark: --device: found no GPU that torch can use; accepted: cpu, or a machine with one")
    table = Table(title=f"Median microseconds per sample, {torch.get_num_threads()} threads, float64, {device}")
    limits, results, stages = Limits.of(device), dict[str, dict[str, float]](), dict[str, Stages]()
    for case in CASES:
        results[case.name], stages[case.name] = measure(case, arguments.samples, arguments.repeats, device, limits)
    measured = measure_consistent(10_500, arguments.repeats, device)
    table.add_column("")
    for case in CASES:
        table.add_column(case.name, justify="right")
    for name in next(iter(results.values())):
        table.add_row(name, *(f"{results[case.name][name]:.1f}" for case in CASES))
    for name in ("per sample, lstsq", "per sample, Gram"):
        ratios = [results[case.name][name] / results[case.name]["torchid"] for case in CASES]
        table.add_row(f"{name} / torchid", *(f"{ratio:.1f}" for ratio in ratios))
    consistent = Table(title="Seconds from the arrays of 10,500 samples of Solo12 to parameters, friction included")
    for name in measured:
        consistent.add_column(name, justify="right")
    consistent.add_row(*(f"{seconds:.2f}" for seconds in measured.values()))
    console = Console(width=100)
    console.print(table)
    console.print(f"products of matrices: {blas_kernels()}")
    console.print(stage_table(stages, limits, device))
    console.print(consistent)
    if device.type == "cpu":
        torch.set_num_threads(1)
        with ThreadpoolController().limit(limits=1):
            console.print(module_table(arguments.repeats))


if __name__ == "__main__":
    main()
