"""Rigid bodies and a learned module beside them: what a descent with a residual module ends with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from torchid.errors import InputError
from torchid.parameters import Array
from torchid.problem import Samples
from torchid.regressor import Regressor
from torchid.robot import Robot

RESIDUAL = "residual.pt"
"""Its file in a run folder."""


class JointNetworks(nn.Module):
    """r(q, v, a): a small network for every joint's torque, from that joint's own motion; no force on the base."""

    def __init__(self, n: int, hidden: int = 16) -> None:
        """Start with zero force, of `n` joints with so many hidden units each."""
        super().__init__()
        self.n = n
        self.weight = nn.Parameter(torch.randn(n, hidden, 3, dtype=torch.float64))
        self.bias = nn.Parameter(torch.randn(n, hidden, dtype=torch.float64))
        self.out = nn.Parameter(torch.zeros(n, hidden, dtype=torch.float64))

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Generalized forces, (B, nv) [N m]."""
        motion = torch.stack([q[:, -self.n :], v[:, -self.n :], 0.1 * a[:, -self.n :]], dim=2)  # (B, n, 3)
        features = torch.tanh((self.weight @ motion[..., None])[..., 0] + self.bias)  # (B, n, hidden)
        return nn.functional.pad((features * self.out).sum(2), (v.shape[1] - self.n, 0))


class RigidPlusResidual(nn.Module):
    """K(q, v, a) phi + r(q, v, a): the generalized forces of rigid bodies and of a learned module.

    `torch.save(model.state_dict(), path)` and `save` keep tensors alone, which `torch.load(path, weights_only=True)`
    reads; `torch.export` takes it as one graph.
    """

    phi: Tensor

    def __init__(self, robot: Robot, phi: Array, residual: nn.Module) -> None:
        """Take over parameters (12 L,) and a module r(q, v, a) -> (B, nv) [N, N m]; arguments as of `Regressor`."""
        super().__init__()
        self.regressor = Regressor(robot)
        self.register_buffer("phi", torch.from_numpy(np.array(phi, dtype=np.float64).ravel()))
        self.residual = residual

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Generalized forces, (B, nv): base force and moment, then joint torques [N, N m]."""
        return self.regressor(q, v, a) @ self.phi + self.residual(q, v, a)

    @torch.no_grad()
    def without_residual(self, samples: Samples) -> Samples:
        """Samples whose joint torques are freed of the module's, for whatever compares them with rigid bodies."""
        if samples.torque is None:
            return samples
        force = self.residual(*samples.coordinates())
        return replace(samples, torque=samples.torque - force[:, force.shape[1] - samples.torque.shape[1] :])

    def save(self, path: str | Path) -> None:
        """Write parameters and module."""
        torch.save({"phi": self.phi, "residual": self.residual.state_dict()}, path)

    @classmethod
    def load(cls, path: str | Path, robot: Robot, residual: nn.Module | None = None) -> RigidPlusResidual:
        """Read what `save` wrote; nothing in the file is run.

        Args:
            path: of the file.
            robot: whose it is.
            residual: a module of the same class to take the numbers up; None for `JointNetworks`.

        Raises:
            InputError: the file is damaged, or of another robot or module.
        """
        try:
            state = torch.load(path, weights_only=True)
            phi, own = state["phi"].numpy(), state["residual"]
            residual = residual or JointNetworks(robot.n, own["out"].shape[1])
            residual.load_state_dict(own)
            if phi.shape != (robot.nominal.size,) or not np.isfinite(phi).all():
                raise ValueError(f"parameters of shape {phi.shape}")
        except OSError:
            raise
        except Exception as error:  # noqa: B902 - an unpickler and torch raise what they like
            found = f"not readable ({(str(error).splitlines() or [type(error).__name__])[0][:200]})"
            raise InputError(
                path, "file", found, "what RigidPlusResidual.save wrote, of this robot and module"
            ) from error
        return cls(robot, phi, residual)
