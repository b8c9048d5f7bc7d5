"""How far a URDF with the terms of actuators that were fitted is from the true robot."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from defaults.models import Model
from torchid.parameters import Array

CUTOFF_HZ = 20.0
"""Errors of forces count up to here, whatever the cutoff of a fit was."""
_STATES = 300
_LIGHT = 1e-3  # kg: bodies without mass of their own
_WITHOUT_COLUMN = ("delay", "torque of a delay")  # of the fit alone: they shift the log


@dataclass(frozen=True)
class Terms:
    """What a fit has of joints beside a URDF: values by kind and joint, and widths of friction's sign [rad/s]."""

    extras: Sequence[Mapping[str, Any]] = ()
    sign_width: float | None = None
    stribeck: float | None = None

    def torque(self, joints: Sequence[str], q: Array, v: Array, a: Array) -> Array:
        """Torques (N, n) [N m] of what is not a scale.

        Raises:
            ValueError: a kind that is not known here.
        """
        out = np.zeros_like(q)
        sign = self.sign(v)
        for one in self.extras:
            kind = str(one["what"])
            if kind in ("scale", *_WITHOUT_COLUMN) or one["name"] not in joints or one["component"]:
                continue
            k = joints.index(one["name"])
            columns = {
                "armature": a[:, k],
                "stiffness": q[:, k],
                "torque_offset": 1.0,
                "offset": 1.0,
                "asymmetric_coulomb": np.abs(sign[:, k]),
                "stribeck": sign[:, k] * np.exp(-((v[:, k] / (self.stribeck or np.inf)) ** 2)),
            }
            if kind not in columns:
                raise ValueError(f"a term '{kind}' of {one['name']}, which scoring.py does not know")
            out[:, k] += one["value"] * columns[kind]
        return out

    def scales(self, joints: Sequence[str]) -> Array:
        """Scales of the readings (n,)."""
        values = {one["name"]: one["value"] for one in self.extras if one["what"] == "scale" and not one["component"]}
        return np.array([1.0 + values.get(name, 0.0) for name in joints])

    def sign(self, v: Array) -> Array:
        """Sign of velocities as the fit has it."""
        return np.sign(v) if not self.sign_width else np.tanh(v / self.sign_width)


@dataclass(frozen=True)
class Score:
    """Errors; of forces along the unseen motion as shares of their rms, and over the given URDF's where it says so.

    Attributes:
        torque, urdf_torque: of the joints.
        force, urdf_force: of the base.
        joints: of each joint over the URDF's error.
        limbs: rigid-body torques in random states over the URDF's error, by limb.
        masses: of each link, identified and the URDF's, over the true one, by its joint.
    """

    torque: float
    urdf_torque: float
    force: float | None
    urdf_force: float | None
    joints: dict[str, float]
    limbs: dict[str, float]
    masses: dict[str, tuple[float, float]]

    @property
    def mass(self) -> float:
        """Median error of the links' masses over the URDF's."""
        return median_mass_error([self])

    @property
    def heaviest(self) -> tuple[float, str]:
        """Largest mass of a link over its true one, and the link's joint."""
        return max((found, name) for name, (found, _) in self.masses.items())

    @property
    def lightest(self) -> tuple[float, str]:
        """The least."""
        return min((found, name) for name, (found, _) in self.masses.items())

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def median_mass_error(scores: Iterable[Score]) -> float:
    """Median error of the masses of all links over that of the URDFs'."""
    off = np.abs(np.array([pair for one in scores for pair in one.masses.values()]) - 1.0)
    return float(np.median(off[:, 0]) / np.median(off[:, 1]))


@dataclass
class Truth:
    """A true robot, its unseen motion and random states."""

    folder: Path
    known: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        self.known = json.loads((self.folder / "truth.json").read_text())
        self.joints, self.floating = tuple(self.known["joints"]), not self.known["held"]
        with np.load(self.folder / "other_truth.npz") as file:
            log = {name: np.asarray(file[name], dtype=float) for name in file.files}
        self.q, self.v, self.a = (log[f"joint_{x}"] for x in ("position", "velocity", "acceleration"))
        self._measured, self._step = log["joint_torque"], float(log["time"][1] - log["time"][0])
        self.model = self._read("true.urdf")
        pose = base_v = base_a = None
        if self.floating:
            pose, base_v, base_a = _base(log)
        self._states = (
            self.model.configuration(self.q, pose),
            self.model.rates(self.v, base_v),
            self.model.rates(self.a, base_a),
        )
        self._ground = np.zeros((len(self.q), self.model.base + len(self.joints)))
        if self.floating:
            self._ground = self.model.forces_of_contacts(
                self._states[0], self.known["feet"], log["contact_wrench_world"]
            )
        self._random = self._random_states()
        self._rigid = self.model.forces(*self._random)[:, self.model.base :]
        self._masses = self.model.masses()
        self.given = self._errors(self.folder / "robot.urdf", Terms())

    def best_known(self) -> Score:
        """The true robot's own errors: what gains of the torques leave, and joints that stick."""
        terms = {"armature": self.known["armature"], "torque_offset": self.known["offset"]}
        extras = [
            {"what": kind, "name": name, "component": None, "value": value}
            for kind, values in terms.items()
            for name, value in zip(self.joints, values, strict=True)
        ]
        return self.score(self.folder / "true.urdf", Terms(extras))

    def score(self, urdf: Path, terms: Terms) -> Score:
        """Compare a URDF and fitted terms with the truth."""
        found, given = self._errors(urdf, terms), self.given
        base = self.model.base
        size = _rms(self._filtered(self._measured))
        limbs = {
            self.joints[limb[0]]: float(_rms(found.rigid[:, limb]) / _rms(given.rigid[:, limb]))
            for limb in self.model.limbs()
        }
        bodies, names = self._masses > _LIGHT, np.array(self.model.bodies)
        ratio, before = (x.masses[bodies] / self._masses[bodies] for x in (found, given))
        force: list[float | None] = [None, None]
        if base:
            weight = _rms(self._filtered(self._ground[:, :3]))
            force = [float(_rms(x.forces[:, :3]) / weight) for x in (found, given)]
        return Score(
            torque=float(_rms(found.forces[:, base:]) / size),
            urdf_torque=float(_rms(given.forces[:, base:]) / size),
            force=force[0],
            urdf_force=force[1],
            joints={
                name: float(_rms(found.forces[:, base + k]) / _rms(given.forces[:, base + k]))
                for k, name in enumerate(self.joints)
            },
            limbs=limbs,
            masses={str(name): (float(x), float(y)) for name, x, y in zip(names[bodies], ratio, before, strict=True)},
        )

    def _errors(self, urdf: Path, terms: Terms) -> _Errors:
        model = self._read(urdf.name if urdf.parent == self.folder else str(urdf))
        forces = model.forces(*self._states) - self._ground
        friction = _friction(urdf, self.joints)
        forces[:, model.base :] += friction[0] * terms.sign(self.v) + friction[1] * self.v
        forces[:, model.base :] += terms.torque(self.joints, self.q, self.v, self.a)
        forces[:, model.base :] /= terms.scales(self.joints)
        forces[:, model.base :] -= self._measured
        rigid = model.forces(*self._random)[:, model.base :] - self._rigid
        return _Errors(self._filtered(forces), rigid, model.masses())

    def _filtered(self, x: Array) -> Array:
        trimmed = round(0.2 / self._step)
        filtered = sosfiltfilt(butter(2, CUTOFF_HZ * 2.0 * self._step, output="sos"), x, axis=0)
        return np.asarray(filtered[trimmed:-trimmed])

    def _read(self, name: str) -> Model:
        return Model.of(self.folder / name, self.joints, self.floating)

    def _random_states(self) -> tuple[Array, Array, Array]:
        """Positions within limits, speeds and accelerations up to those of the unseen log below the cutoff."""
        rng, n = np.random.default_rng(0), len(self.joints)
        lower, upper = self.model.limits()
        q = rng.uniform(lower, upper, (_STATES, n))
        pose = np.zeros((_STATES, 7))
        quat = rng.normal(size=(_STATES, 4))
        pose[:, 3:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        fastest = [np.quantile(np.abs(self._filtered(x)), 0.995, axis=0) for x in self._states[1:]]
        v, a = (x * rng.uniform(-1.0, 1.0, (_STATES, len(x))) for x in fastest)
        return self.model.configuration(q, pose), v, a


@dataclass(frozen=True)
class _Errors:
    forces: Array  # (N, 6 + n) of the unseen motion
    rigid: Array  # (S, n) of random states
    masses: Array


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _friction(urdf: Path, joints: Sequence[str]) -> Array:
    """Coulomb and viscous friction that a URDF states, (2, n)."""
    found = {joint.get("name"): joint.find("dynamics") for joint in etree.parse(str(urdf)).getroot().findall("joint")}
    entries = [{} if found[name] is None else found[name].attrib for name in joints]
    return np.array([[float(one.get(key, 0.0)) for one in entries] for key in ("friction", "damping")])


def _base(log: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Pose, velocity and acceleration of a base as Pinocchio has them, along its own axes."""
    turn = Rotation.from_quat(log["base_quat_xyzw"]).inv()
    v, omega = turn.apply(log["base_linear_velocity_world"]), log["base_angular_velocity_base"]
    a = turn.apply(log["base_linear_acceleration_world"]) - np.cross(omega, v)
    pose = np.hstack([log["base_position_world"], log["base_quat_xyzw"]])
    return pose, np.hstack([v, omega]), np.hstack([a, log["base_angular_acceleration_base"]])
