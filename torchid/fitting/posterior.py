"""The posterior of a fit, which draws parameter sets, and rigid bodies with a learned module beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchid import parameters
from torchid.errors import InputError, LogError, during
from torchid.estimators import Conditions, Enclosure, Mirror
from torchid.estimators.posterior import PRIOR_ERROR, NominalError, Posterior, nominal_error, whitened_rows
from torchid.estimators.truncated_gaussian import TruncatedGaussian
from torchid.fitting.fit import Fit
from torchid.identifiability.confounding import mass_weights
from torchid.logs.containers import open_container
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem import Samples
from torchid.problem.extras import ACTUATORS, in_words
from torchid.regressor import Regressor
from torchid.reprs import short_repr
from torchid.robot import Robot

POSTERIOR = "posterior.npz"
"""Name of the file in a run folder."""

_FORMAT = 1
_LARGEST = 1e100  # squares stay within the range of float64
_TEXTS = ("body_names", "joint_names", "extra_names", "extra_units")
_NUMBERS = ("A", "D", "b", "nominal", "scale", "free", "extra_size", "extra_lower")


@dataclass(frozen=True, kw_only=True)
class FittedPosterior:
    """Posterior of a fit, with names.

    Attributes:
        posterior: of the parameters, in the order of `body_names` and `torchid.parameters.PARAMETERS`.
        body_names: of the L bodies.
        joint_names: of the joints that move them, "" for the base.
        extra_names: labels of the S extra parameters of all logs, such as "armature of l_knee".
        extra_units: of the extra parameters.
    """

    posterior: Posterior
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    extra_names: tuple[str, ...]
    extra_units: tuple[str, ...]

    __repr__ = short_repr

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, such as "l_knee.m", then of the extra parameters."""
        return (*(f"{body}.{name}" for body in self.body_names for name in PARAMETERS), *self.extra_names)

    @cached_property
    def nominal_error(self) -> NominalError | None:
        """Error of the nominal bodies that the data determine; None if the data determine none."""
        return nominal_error(self.posterior)

    def prior_error(self, wanted: float | Literal["auto"]) -> float:
        """Width of the prior as a number. "auto" is the default width unless the data contradict it significantly."""
        if wanted != "auto":
            return wanted
        error = self.nominal_error
        return error.value if error is not None and error.clear else PRIOR_ERROR


def fitted_posterior(fit: Fit, robot: Robot, conditions: Conditions) -> FittedPosterior:
    """The posterior of a fit, with the noise that its standard errors are of.

    Args:
        fit: of a robot.
        robot: for names.
        conditions: that samples are to meet.
    """
    problem = fit.assembly.problem
    estimate = fit.estimate
    noise = math.sqrt(problem.oversampling) * estimate.residual_std
    deviations = None if fit.jackknife is None else fit.jackknife.without_ridge[: fit.jackknife.blocks]
    reported = np.vstack([np.eye(len(problem.nominal)), mass_weights(len(robot.bodies))])
    A, b = whitened_rows(problem, noise, deviations, reported)
    D = np.zeros((len(A), 0))
    extras = []
    for x in fit.assembly.eliminations:
        if x.log:
            continue
        extras = list(x.extras)
        noise_of_rows = max(noise, 1e-8 * float(np.linalg.norm(x.z)) / max(len(x.z), 1) ** 0.5, 1e-300)
        A = np.concatenate([A, x.C[:, : len(problem.nominal)] / noise_of_rows])
        D = np.concatenate([np.zeros((len(D), len(extras))), np.linalg.pinv(x.inverse) / noise_of_rows])
        b = np.concatenate([b, x.z / noise_of_rows])
    joints = (body.joint for body in robot.bodies)
    values_of_extras = {x.extra.label: x.value for x in fit.extras if not x.log}
    return FittedPosterior(
        posterior=Posterior(
            A=A,
            D=D,
            b=b,
            nominal=problem.nominal,
            scale=_scale_of_prior(problem.scale, estimate.phi - problem.nominal),
            free=problem.free,
            conditions=conditions,
            extra_size=np.array([max(extra.size, abs(values_of_extras.get(extra.label, 0.0))) for extra in extras]),
            extra_lower=np.array([0.0 if extra.nonnegative else -np.inf for extra in extras]),
        ),
        body_names=tuple(robot.body_names),
        joint_names=tuple("" if joint is None else joint.name for joint in joints),
        extra_names=tuple(extra.label for extra in extras),
        extra_units=tuple(extra.unit for extra in extras),
    )


def _scale_of_prior(scale: Array, moved: Array) -> Array:
    """Units of the parameters, (12 L,), in which the prior is stated: friction is as uncertain as it was found to be.

    Files of robots seldom state friction, and a joint may have 0.01 or 100 N m of it: one width for all would draw
    samples away from data that are many times as sharp.

    Args:
        scale: (12 L,), of the fit.
        moved: (12 L,), how far the estimate is from the nominal parameters.
    """
    out = scale.copy()
    friction, moved_friction = (x.reshape(-1, PER_BODY)[:, parameters.FRICTION] for x in (out, np.abs(moved)))
    friction[...] = np.maximum(friction, moved_friction / PRIOR_ERROR)
    return out


def posterior_arrays(fitted: FittedPosterior) -> dict[str, NDArray[Any]]:
    """What the file of a posterior holds, by name."""
    conditions = fitted.posterior.conditions
    lower, upper = conditions.bounds(len(fitted.body_names))
    enclosures = conditions.enclosures
    mirrors = conditions.mirrors
    return {
        "format": np.array(_FORMAT),
        **{name: np.asarray(getattr(fitted.posterior, name)) for name in _NUMBERS},
        **{name: np.array(getattr(fitted, name), dtype=np.str_) for name in _TEXTS},
        "margin": np.array(conditions.margin),
        "total_mass": np.array(np.nan if conditions.total_mass is None else conditions.total_mass),
        "lower": lower,
        "upper": upper,
        "enclosure_body": np.array([x.body for x in enclosures], dtype=np.int64),
        "enclosure_kind": np.array([x.kind for x in enclosures], dtype=np.str_),
        "enclosure_centre": np.array([x.centre for x in enclosures]).reshape(-1, 3),
        "enclosure_axes": np.array([x.axes for x in enclosures]).reshape(-1, 3, 3),
        "enclosure_half": np.array([x.half for x in enclosures]).reshape(-1, 3),
        "mirror_bodies": np.array([(x.body, x.image) for x in mirrors], dtype=np.int64).reshape(-1, 2),
        "mirror_reflection": np.array([x.reflection for x in mirrors]).reshape(-1, 3, 3),
    }


def write_posterior(path: Path, fitted: FittedPosterior) -> None:
    """Write the file of a posterior into a folder that is being made."""
    with path.open("xb") as stream:
        named: dict[str, Any] = posterior_arrays(fitted)
        np.savez_compressed(stream, **named)


def read_posterior(path: Path) -> FittedPosterior:
    """Read the posterior of a run, from its folder or from its `posterior.npz`.

    Raises:
        InputError: there is none, or the file is damaged.
    """
    file = path / POSTERIOR if path.is_dir() else path
    if not file.exists():
        accepted = "a run folder of this version; run torchid identify again with overwrite=true"
        raise InputError(path, "RUN", f"no {POSTERIOR} in it" if path.is_dir() else "no such file or folder", accepted)
    try:
        with during("reading", file), open_container(file) as container:
            arrays = {name: container.load(name) for name in container.declared_bytes()}
            return _posterior(arrays)
    except LogError as error:
        raise InputError(file, "file", error.found, f"{POSTERIOR} of a run folder") from error
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(file, "file", f"not a posterior ({error})", f"{POSTERIOR} of a run folder") from error


def _posterior(arrays: Mapping[str, NDArray[Any]]) -> FittedPosterior:
    """The posterior; ValueError or KeyError if the arrays are not those of one."""
    if arrays["format"].shape != () or int(arrays["format"]) != _FORMAT:
        raise ValueError("written by another version of torchid")
    texts = {name: tuple(str(x) for x in arrays[name].reshape(-1)) for name in _TEXTS}
    bodies = len(texts["body_names"])
    extras = len(texts["extra_names"])
    shapes = {"D": (-1, extras), "b": (-1,), "extra_size": (extras,), "extra_lower": (extras,), "A": (-1, 12 * bodies)}
    numbers = {name: _numbers(arrays, name, shapes.get(name, (PER_BODY * bodies,))) for name in _NUMBERS}
    if not (len(numbers["A"]) == len(numbers["D"]) == len(numbers["b"])):
        raise ValueError("A, D and b have different numbers of rows")
    if not ((numbers["scale"] > 0.0).all() and (numbers["extra_size"] > 0.0).all()):
        raise ValueError("scale or extra_size is not positive")
    if not np.isin(numbers["extra_lower"], (0.0, -np.inf)).all():
        raise ValueError("extra_lower is neither 0 nor minus infinity")
    total = float(arrays["total_mass"])
    conditions = Conditions(
        margin=float(arrays["margin"]),
        total_mass=None if math.isnan(total) else total,
        enclosures=tuple(
            Enclosure(int(body), str(kind), centre, axes, half)  # type: ignore[arg-type]
            for body, kind, centre, axes, half in zip(
                *(arrays[f"enclosure_{name}"] for name in ("body", "kind", "centre", "axes", "half")), strict=True
            )
        ),
        mirrors=tuple(
            Mirror(int(pair[0]), int(pair[1]), reflection)
            for pair, reflection in zip(arrays["mirror_bodies"], arrays["mirror_reflection"], strict=True)
        ),
        lower=_numbers(arrays, "lower", (bodies, PER_BODY)),
        upper=_numbers(arrays, "upper", (bodies, PER_BODY)),
        names=texts["body_names"],
    )
    conditions.validate_bodies(bodies)
    conditions.bounds(bodies)
    return FittedPosterior(posterior=Posterior(conditions=conditions, **numbers), **texts)


def _numbers(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> Array:
    """An array of the given shape (-1 for any length); ValueError for another shape or numbers out of range."""
    array = np.asarray(arrays[name])
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or array.dtype != (np.bool_ if name == "free" else np.float64):
        raise ValueError(f"{name} is not a number array of shape {shape}")
    bounds = name in ("lower", "upper", "extra_lower")
    if np.isnan(array).any() or not (bounds or (np.abs(array) <= _LARGEST).all()):
        raise ValueError(f"{name} has a number that is not finite")
    return array


@dataclass(frozen=True)
class ParameterSamples:
    """N physically consistent parameter sets of one robot.

    Attributes:
        phi: (N, L, 12), in the order of `torchid.parameters.PARAMETERS`, inertia about the link's origin.
        extras: (N, S), extra parameters of all logs.
        body_names: of the L bodies.
        joint_names: of the joints that move them, "" for the base.
        extra_names: of the extra parameters, such as "armature of l_knee".
        extra_units: of the extra parameters.
    """

    phi: Tensor
    extras: Tensor
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    extra_names: tuple[str, ...]
    extra_units: tuple[str, ...]

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.phi)

    @property
    def mass(self) -> Tensor:
        """Masses, (N, L) [kg]."""
        return self.phi[..., parameters.MASS]

    @property
    def center_of_mass(self) -> Tensor:
        """Centres of mass in the link frames, (N, L, 3) [m]; 0 for bodies without mass."""
        mass = self.mass[..., None]
        return torch.where(mass > 0.0, self.phi[..., parameters.FIRST_MOMENT] / torch.where(mass > 0.0, mass, 1.0), 0.0)

    @property
    def inertia(self) -> Tensor:
        """Inertia about the centre of mass, along the axes of the link frame, (N, L, 3, 3) [kg m^2]."""
        com = self.center_of_mass
        about_origin = com.new_empty(*com.shape, 3)
        numbers = self.phi[..., parameters.INERTIA].unbind(-1)
        for value, (row, column) in zip(numbers, parameters.INERTIA_AXES, strict=True):
            about_origin[..., row, column] = about_origin[..., column, row] = value
        squared = com.square().sum(-1)[..., None, None] * torch.eye(3, dtype=com.dtype, device=com.device)
        return about_origin - self.mass[..., None, None] * (squared - com[..., :, None] * com[..., None, :])

    @property
    def coulomb_friction(self) -> Tensor:
        """Coulomb friction of the joints that move the bodies, (N, L) [N m or N]."""
        return self.phi[..., parameters.COULOMB]

    @property
    def viscous_friction(self) -> Tensor:
        """Viscous friction of the joints that move the bodies, (N, L) [N m s/rad or N s/m]."""
        return self.phi[..., parameters.VISCOUS]

    def of_joints(self, what: str) -> dict[str, Tensor]:
        """Values of an actuator term by joint, each (N,).

        Raises:
            ValueError: `what` is not one of `ACTUATORS`.
        """
        if what not in ACTUATORS:
            raise ValueError(f"what: found '{what}'; accepted: {', '.join(ACTUATORS)}")
        start = f"{in_words(what)} of "
        return {
            name.removeprefix(start): self.extras[:, number]
            for number, name in enumerate(self.extra_names)
            if name.startswith(start)
        }


class PosteriorSampler(torch.nn.Module):
    """Draws parameter sets from the posterior of a run, on the device of the module.

    In a training script::

        sampler = torchid.PosteriorSampler("runs/g1").to("cuda")
        samples = sampler.sample(4096, torch.Generator("cuda").manual_seed(0))
        samples.mass, samples.center_of_mass, samples.inertia, samples.of_joints("armature")

    Each set meets all conditions of the run: physically consistent bodies, non-negative friction, bounds. Where the
    data determine a parameter, its samples vary by the standard error; elsewhere by the width of the prior. Sampling is
    not differentiable and runs in float64.

    Args:
        run: run folder of `torchid identify`, its `posterior.npz`, or a `FittedPosterior`.
        prior_error: standard deviation of the nominal parameters, relative to each body. "auto": 0.2, or the error of
            the bodies that the data determine, if it contradicts 0.2.

    Raises:
        InputError: the folder is not a run, or a run of an older version.
    """

    def __init__(self, run: str | Path | FittedPosterior, prior_error: float | Literal["auto"] = PRIOR_ERROR) -> None:
        super().__init__()
        if prior_error != "auto" and not (isinstance(prior_error, (int, float)) and 0.0 < prior_error < math.inf):
            raise InputError("sampler", "prior_error", f"{prior_error}", "a number above 0, or 'auto'")
        self.fitted = run if isinstance(run, FittedPosterior) else read_posterior(Path(run))
        posterior = self.fitted.posterior
        prior_error = self.fitted.prior_error(prior_error)
        conic = posterior.conic_problem(prior_error)
        self.draws = TruncatedGaussian(conic, posterior.owners())
        count = int(posterior.free.sum())
        to_free = posterior.scale[posterior.free, None] * conic.deviations[:count, :count]
        for name, array in (
            ("nominal", posterior.nominal),
            ("free", posterior.free),
            ("to_free", to_free),
            ("extra_size", posterior.extra_size),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(array)))

    nominal: Tensor
    free: Tensor
    to_free: Tensor
    extra_size: Tensor

    @torch.no_grad()
    def sample(self, count: int, generator: torch.Generator | None = None) -> ParameterSamples:
        """Draw parameter sets.

        Args:
            count: number N of sets.
            generator: of random numbers, on the module's device; None for torch's default.

        Raises:
            ValueError: `count` is below 1, or the module was converted to less than float64.
        """
        if count < 1:
            raise ValueError(f"count: found {count}; accepted: at least 1")
        if self.nominal.dtype != torch.float64:
            raise ValueError(f"module: found {self.nominal.dtype}; accepted: float64; convert the samples instead")
        x = self.draws.draw(count, generator)
        phi = self.nominal.repeat(count, 1)
        phi[:, self.free] += x[:, : len(self.to_free)] @ self.to_free.T
        return ParameterSamples(
            phi.view(count, -1, PER_BODY),
            x[:, len(self.to_free) :] * self.extra_size,
            self.fitted.body_names,
            self.fitted.joint_names,
            self.fitted.extra_names,
            self.fitted.extra_units,
        )

    forward = sample


RESIDUAL = "residual.pt"
"""Its file in a run folder."""


class JointNetworks(nn.Module):
    """Residual module r(q, v, a): a small network per joint torque, of that joint's motion; no force on the base."""

    def __init__(self, n: int, hidden: int = 16) -> None:
        """Start with zero force, for `n` joints with `hidden` hidden units each."""
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
    """Generalized forces of rigid bodies and a learned module: K(q, v, a) phi + r(q, v, a).

    `save` and `torch.save(model.state_dict(), path)` store tensors only; `torch.load(path, weights_only=True)` reads
    them. `torch.export` exports the model as one graph.
    """

    phi: Tensor

    def __init__(self, robot: Robot, phi: Array, residual: nn.Module) -> None:
        """Combine parameters (12 L,) and a module r(q, v, a) -> (B, nv) [N, N m]; arguments as in `Regressor`."""
        super().__init__()
        self.regressor = Regressor(robot)
        self.register_buffer("phi", torch.from_numpy(np.array(phi, dtype=np.float64).ravel()))
        self.residual = residual

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Generalized forces, (B, nv): base force and moment, then joint torques [N, N m]."""
        return self.regressor(q, v, a) @ self.phi + self.residual(q, v, a)

    @torch.no_grad()
    def without_residual(self, samples: Samples) -> Samples:
        """Subtract the module's joint torques from samples, to compare them with rigid bodies."""
        if samples.torque is None:
            return samples
        force = self.residual(*samples.coordinates())
        return replace(samples, torque=samples.torque - force[:, force.shape[1] - samples.torque.shape[1] :])

    def save(self, path: str | Path) -> None:
        """Write parameters and module to a file."""
        torch.save({"phi": self.phi, "residual": self.residual.state_dict()}, path)

    @classmethod
    def load(cls, path: str | Path, robot: Robot, residual: nn.Module | None = None) -> RigidPlusResidual:
        """Read a file of `save`; no code in the file is executed.

        Args:
            path: of the file.
            robot: the robot of the model.
            residual: a module of the same class that takes the weights; None for `JointNetworks`.

        Raises:
            InputError: the file is damaged, or belongs to another robot or module.
        """
        try:
            state = torch.load(path, weights_only=True)
            phi = state["phi"].numpy()
            module_state = state["residual"]
            residual = residual or JointNetworks(robot.n, module_state["out"].shape[1])
            residual.load_state_dict(module_state)
            if phi.shape != (robot.nominal.size,) or not np.isfinite(phi).all():
                raise ValueError(f"parameters of shape {phi.shape}")
        except OSError:
            raise
        except Exception as error:  # noqa: B902 - an unpickler and torch raise what they like
            reason = f"not readable ({(str(error).splitlines() or [type(error).__name__])[0][:200]})"
            accepted = "a file that RigidPlusResidual.save wrote for this robot and module"
            raise InputError(path, "file", reason, accepted) from error
        return cls(robot, phi, residual)
