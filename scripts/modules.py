"""Calls of the public modules beside what a Python loop over Pinocchio and NumPy takes, for `scripts/benchmark.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin
import torch
from torch import Tensor

from torchid.parameters import Array
from torchid.regressor import FrameJacobian, InverseDynamics, Regressor
from torchid.robot import Robot
from torchid.sensing import Projection

Work = tuple[Callable[[], object], int]
"""Something to time, and the number of samples that it is for."""

PEERS = ("regressor", "rnea", "frame Jacobian", "projection")
ROWS = (
    ("Regressor, out=, 4096", "regressor", "4096"),
    ("Regressor, out=, 256", "regressor", "256"),
    ("Regressor, out=, 256, float32", "regressor", "256 single"),
    ("Regressor, forward and backward, 256", "regressor", "256 backward"),
    ("Regressor, 32", "regressor", "32"),
    ("Regressor, 1", "regressor", "1"),
    ("InverseDynamics, 256", "rnea", "rnea 256"),
    ("InverseDynamics, forward and backward, 256", "rnea", "rnea 256 backward"),
    ("FrameJacobian, 256", "frame Jacobian", "frame 256"),
    ("Projection, out=, 256", "projection", "projection 256"),
    ("Projection, out=, 2048", "projection", "projection 2048"),
)
"""Title, the peer, and what is timed."""


@dataclass(frozen=True)
class ModuleCase:
    """A robot, its feet, and how many rows a foot has."""

    robot: Robot
    urdf: str
    feet: tuple[str, ...]
    foot_rows: int

    def state(self, samples: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
        """Random q, v and a."""
        generator = torch.Generator().manual_seed(1)
        sizes = (self.robot.n + 7, self.robot.nv, self.robot.nv)
        (q, v, a) = (torch.randn(samples, size, generator=generator, dtype=torch.float64).to(dtype) for size in sizes)
        return q, v, a

    def works(self) -> dict[str, Work]:
        """All that is timed, by name."""
        return {**self._peers(), **self._regressors(), **self._others(), **self._projections()}

    def _peers(self) -> dict[str, Work]:
        model = pin.buildModelFromUrdf(self.urdf, pin.JointModelFreeFlyer())
        data = model.createData()
        (q, v, a) = (x.numpy() for x in self.state(256))
        foot = model.getFrameId(self.feet[0], pin.FrameType.BODY)
        (J, active, K, torque, _) = (x.numpy() for x in self.to_project(256))
        K = np.ascontiguousarray(K)
        f = np.pad(torque, ((0, 0), (6, 0)))

        def regressors() -> None:
            for x in zip(q, v, a, strict=True):
                pin.computeJointTorqueRegressor(model, data, *x).copy()

        def rnea() -> None:
            for x in zip(q, v, a, strict=True):
                pin.rnea(model, data, *x).copy()

        def jacobians() -> None:
            for x in q:
                pin.computeFrameJacobian(model, data, x, foot, pin.LOCAL).copy()

        def projections() -> None:
            for sample in range(256):
                V = null_space(J[sample][active[sample]], K.shape[1])
                V @ K[sample]
                V @ f[sample]

        works = (regressors, rnea, jacobians, projections)
        return {name: (work, 256) for name, work in zip(PEERS, works, strict=True)}

    def _regressors(self) -> dict[str, Work]:
        module = Regressor(self.robot)
        single = Regressor(self.robot).float()
        works: dict[str, Work] = {}
        for samples in (1, 32, 256, 4096):
            works[str(samples)] = in_place(module, self.state(samples)), samples
        works["256 single"] = in_place(single, self.state(256, torch.float32)), 256
        weights = torch.ones_like(module(*self.state(256)))
        state = [x.requires_grad_() for x in self.state(256)]
        works["256 backward"] = (lambda: torch.autograd.grad(module(*state), state, weights)), 256
        return works

    def _others(self) -> dict[str, Work]:
        dynamics = InverseDynamics(self.robot)
        foot = FrameJacobian(self.robot, self.feet[0])
        phi = torch.from_numpy(self.robot.nominal.flatten())
        state = self.state(256)
        inputs = [x.clone().requires_grad_() for x in (*state, phi)]
        weights = torch.ones_like(dynamics(*state, phi))
        return {
            "rnea 256": (without_gradients(lambda: dynamics(*state, phi)), 256),
            "rnea 256 backward": (lambda: torch.autograd.grad(dynamics(*inputs), inputs, weights), 256),
            "frame 256": (without_gradients(lambda: foot(state[0])), 256),
        }

    def _projections(self) -> dict[str, Work]:
        project = Projection([True] * self.robot.n, [False] * (self.foot_rows * len(self.feet)))
        works: dict[str, Work] = {}
        for samples in (256, 2048):
            batch = self.to_project(samples)
            out = project(*batch, pad=True)
            works[f"projection {samples}"] = partial(project, *batch, pad=True, out=out), samples
        return works

    def to_project(self, samples: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Arguments of a projection: all feet stand in two thirds of the samples, else all but the first."""
        state = self.state(samples)
        J = torch.cat([FrameJacobian(self.robot, foot)(state[0])[:, : self.foot_rows] for foot in self.feet], dim=1)
        active = torch.ones(samples, J.shape[1], dtype=torch.bool)
        active[2 * samples // 3 :, : self.foot_rows] = False
        return J, active, Regressor(self.robot)(*state), state[1][:, 6:], torch.zeros(samples, J.shape[1]).double()


def in_place(module: Regressor, state: tuple[Tensor, Tensor, Tensor]) -> Callable[[], object]:
    """Calls that write to the same memory."""
    out = module(*state)
    return without_gradients(lambda: module(*state, out=out))


def on_threads(count: int, work: Callable[[], object]) -> Callable[[], None]:
    """The same, on so many threads."""

    def run() -> None:
        before = torch.get_num_threads()
        torch.set_num_threads(count)
        work()
        torch.set_num_threads(before)

    return run


def without_gradients(work: Callable[[], object]) -> Callable[[], object]:
    """The same in inference mode."""
    return torch.inference_mode()(work)


def null_space(A: Array, size: int) -> Array:
    """Rows that span the null space of one matrix (k, size)."""
    _, singular, Vh = np.linalg.svd(A)
    return Vh[(singular > 1e-9 * singular.max(initial=0.0)).sum() :]
