"""What files of compressed logs hold: how rows were formed, and parts as documents of JSON and an array of numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.errors import LogError, join_names
from torchid.guards import MAX_LETTERS
from torchid.parameters import Array
from torchid.problem import RowBuilder, TriangularFactor
from torchid.problem.compression import Part
from torchid.problem.noise import noise_of_sensors
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.robot.tree import BodyJoint
from torchid.rounding import KINEMATIC_TOLERANCE
from torchid.sensing import Contact
from torchid.sensing.sensors import measured_components
from torchid.settings import STRICT, NotNegative

Value = bool | int | float | str | list[str] | None

NOISE = "sensors.noise"
"""Key of an experiment file under which noise is stated."""


@plain_dataclass(frozen=True)
class RowModel:
    """Robot, contacts, sensors, extra parameters and preprocessing that rows were formed with.

    Attributes:
        settings: by the key of an experiment file that they come from; names of the robot's parts under "robot.urdf",
            and the number of columns.
        noise: standard deviations of the sensors by group [N m, N].
        geometry: constants of the kinematic tree and poses of contacts, in units of the URDF.
    """

    settings: dict[str, Value]
    noise: dict[str, float]
    geometry: dict[str, Array]

    __repr__ = short_repr

    @classmethod
    def of(cls, robot: Robot, builder: RowBuilder, preprocessing: Mapping[str, float | None]) -> RowModel:
        """The model of the rows of a builder.

        Nominal inertial parameters, friction to fit and all other settings of estimators are not in it: these are the
        affair of a fit, and robots of one type may differ in them.

        Args:
            robot: the robot.
            builder: of the rows.
            preprocessing: settings that samples depend on.
        """
        tree, extras = builder.tree, builder.extras
        labels = {
            kind: [f"{x.label}, {'by log' if x.per_log else 'of all logs'}" for x in extras if x.what == kind]
            for kind in ("offset", "scale")
        }
        settings: dict[str, Value] = {
            "robot.base_link": robot.base_link,
            "robot.fixed_base": robot.fixed_base,
            "robot.urdf": [f"{body.name} ({_joint_text(body.joint)})" for body in robot.bodies],
            "contacts": [_contact_text(contact) for contact in builder.contacts],
            "sensors": _channels(robot, builder),
            "sensors.offsets": labels["offset"],
            "sensors.scales": labels["scale"],
            "actuators": [x.label for x in extras if x.what not in labels],
            "actuators.sign_width": tree.sign_width,
            "columns": builder.width,
        }
        if robot.welded:  # a factor of a robot without stays what it was
            settings["robot.weld"] = [f"{name} at {position!r}" for name, position in robot.welded.items()]
        if robot.loops:
            settings["robot.loops"] = [f"{loop.kind} of {loop.label}" for loop in robot.loops]
        if robot.passive:
            settings["robot.passive"] = list(robot.passive)
        if tree.stribeck is not None:
            settings["actuators.stribeck"] = tree.stribeck
        if any(robot.base_tilt):
            settings["robot.base_tilt"] = ", ".join(map(repr, robot.base_tilt))
        for name in ("armature", "stiffness", "spring_torque"):
            if (stated := getattr(robot, name)).any():  # of an MJCF robot, taken off the right-hand side
                settings[f"robot.mjcf {name}"] = [repr(float(x)) for x in stated]
        settings |= {f"preprocessing.{name}": value for name, value in preprocessing.items()}
        geometry = {
            "T_parent_joint": tree.T_parent_joint,
            "T_joint_link": tree.T_joint_link,
            "joint_map": tree.joint_map.cpu().numpy(),
            "joint_constant": tree.joint_constant.cpu().numpy(),
            "contact_node": np.array([node for node, _ in builder.frames], dtype=float),
            "T_node_contact": np.array([pose for _, pose in builder.frames]).reshape(-1, 4, 4),
        }
        if robot.loops:
            poses = [tree.frame(robot, frame)[1] for loop in robot.loops for frame in loop.frames]
            geometry["T_node_loop"] = np.array(poses)
        return cls(settings, noise_of_sensors(builder), geometry)


def require_same_rows(path: object, found: RowModel, expected: RowModel, reference: str) -> None:
    """Refuse factors of rows that were formed with something else than others; noise is another matter.

    Args:
        path: of the factors, for the message.
        found: what they were formed with.
        expected: what they should have been formed with.
        reference: where that is stated.

    Raises:
        LogError: names the setting, its value and the accepted one.
    """
    for key in (*expected.settings, *(key for key in found.settings if key not in expected.settings)):
        one, other = found.settings.get(key), expected.settings.get(key)
        if one != other:
            raise LogError(path, key, *_texts(one, other, reference))
    if found.noise.keys() != expected.noise.keys():
        raise LogError(path, NOISE, join_names(list(found.noise)) or "none", join_names(list(expected.noise)))
    for name, array in expected.geometry.items():
        own = found.geometry[name]
        if own.shape != array.shape or not np.allclose(own, array, rtol=0.0, atol=KINEMATIC_TOLERANCE):
            raise LogError(path, "robot.urdf", _where(name, own, array, expected), f"the kinematics of {reference}")


def require_same_noise(path: object, found: RowModel, expected: RowModel, reference: object) -> None:
    """Refuse factors that were weighted with other noise than others, of rows that are alike otherwise.

    Raises:
        LogError: names the noise, its value and the accepted one.
    """
    for group, value in expected.noise.items():
        if not np.isclose(found.noise[group], value, rtol=KINEMATIC_TOLERANCE, atol=0.0):
            accepted = f"{value:g}, as in {reference}: compress with all of sensors.noise stated"
            raise LogError(path, f"{NOISE}.{group}", f"{found.noise[group]:g}", accepted)


def _contact_text(contact: Contact) -> str:
    kind = f"line along {contact.line_axis}" if contact.kind == "line" else contact.kind
    if contact.radius:  # a factor of a contact that does not roll stays what it was
        kind += f", radius {contact.radius!r} m, normal {', '.join(map(repr, contact.normal))}"
    if any(contact.centre):
        kind += f", centre {', '.join(map(repr, contact.centre))} m"
    if contact.along_normal:
        kind += f", read along {', '.join(map(repr, contact.normal))}"
    return f"{contact.frame} ({kind})"


def _joint_text(joint: BodyJoint | None) -> str:
    return "base" if joint is None else f"{joint.kind} {joint.name}"


def _channels(robot: Robot, builder: RowBuilder) -> list[str]:
    """Measured channels by name."""
    measured = measured_components(builder.contacts, builder.sensors)
    names = [robot.dof_names[dof] for dof in np.flatnonzero(builder.sensors.torque)]
    return names + [
        f"{builder.contacts[i].frame} {builder.contacts[i].component_name(k)}" for i, k in np.argwhere(measured)
    ]


def _texts(found: Value, expected: Value, reference: str) -> tuple[str, str]:
    """What was found and what is accepted, in words."""
    if not (isinstance(found, list) and isinstance(expected, list)):
        return _text(found), f"{_text(expected)}, as in {reference}"
    missing, more = ([x for x in a if x not in b] for a, b in ((expected, found), (found, expected)))
    texts = [f"{what} {join_names(names)}" for what, names in (("without", missing), ("with", more)) if names]
    return " and ".join(texts) or "another order", f"those of {reference}: {join_names(expected) or 'none'}"


def _text(value: Value) -> str:
    if isinstance(value, list):
        return join_names(value) or "none"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _where(name: str, found: Array, expected: Array, model: RowModel) -> str:
    """Which part of a robot differs, and by how much."""
    if found.shape != expected.shape:
        return f"{name} of shape {found.shape}"
    apart = np.abs(found - expected).reshape(len(expected), -1).max(axis=1)
    worst = int(apart.argmax())
    if "contact" in name:
        contacts = model.settings["contacts"]
        return f"contact {contacts[worst] if isinstance(contacts, list) else worst} is {apart[worst]:.2g} off"
    bodies = model.settings["robot.urdf"]
    known = isinstance(bodies, list) and len(bodies) == len(expected)
    part = f"{bodies[worst]}" if isinstance(bodies, list) and known else f"frame {worst}"
    return f"{name} of {part} is {apart[worst]:.2g} off"


Whole = Annotated[int, Field(ge=0, le=2**53)]


@dataclass(config=STRICT, frozen=True)
class PackedPart:
    """A part but for the numbers of its triangles, as documents of JSON have it.

    `state`: a digit for each contact; `triangles`: number of the support, rows, whether packed as a triangle;
    `noise_gram`: numbers of the supports.
    """

    state: str
    samples: Whole
    rows: Whole
    independent_rows: NotNegative
    masked: Annotated[list[Whole], Field(alias="gated")]  # as files of this format call it
    triangles: list[tuple[Whole, Whole, bool]]
    noise_gram: Annotated[list[Whole], Field(alias="surplus")]  # as files of this format call it


class PartPacker:
    """Takes parts apart, one after the other."""

    def __init__(self) -> None:
        self._supports, self._values = dict[tuple[int, ...], int](), list[Array]()

    @property
    def supports(self) -> list[tuple[int, ...]]:
        """Columns of the blocks so far, which triangles name by number."""
        return list(self._supports)

    @property
    def values(self) -> Array:
        """The numbers of all triangles so far."""
        return np.concatenate([np.empty(0), *self._values])

    def pack(self, parts: Sequence[Part]) -> list[dict[str, object]]:
        """The documents of further parts, each as `PackedPart` reads it; their names and folds are not in them."""
        out: list[dict[str, object]] = []
        for part in parts:
            triangles = []
            for support, block in part.factor.blocks.items():
                rows = block.cpu().numpy()
                packed = len(rows) == rows.shape[1] and not np.tril(rows, -1).any()
                self._values.append(rows[np.triu_indices(len(rows))] if packed else rows.ravel())
                triangles.append((self._number(support), len(rows), packed))
            for x in part.factor.noise_gram.values():
                self._values.append(x.cpu().numpy()[np.triu_indices(len(x))])
            out.append(
                {
                    "state": "".join("01"[active] for active in part.state),
                    "samples": part.samples,
                    "rows": part.factor.rows,
                    "independent_rows": part.factor.independent_rows,
                    "gated": sorted(part.masked),
                    "triangles": triangles,
                    "surplus": [self._number(support) for support in part.factor.noise_gram],
                }
            )
        return out

    def _number(self, support: tuple[int, ...]) -> int:
        return self._supports.setdefault(support, len(self._supports))


class PartReader:
    """Parts of a log, read one after the other; ValueError where one cannot be that of a log."""

    def __init__(
        self,
        values: Array,
        supports: Sequence[Sequence[int]],
        columns: int,
        contacts: int,
        extras: int,
        most: float = math.inf,
    ) -> None:
        """Nothing is read yet.

        Args:
            values: numbers of all triangles.
            supports: columns of blocks, that triangles name by number.
            columns: how many the problem has.
            contacts: how many there are.
            extras: how many extra parameters there are.
            most: triangles.
        """
        self._columns, self._contacts, self._extras, self._most = columns, contacts, extras, most
        self._supports = [_support(one, columns) for one in supports]
        self._stream, self._triangles = _Stream(values), 0

    @property
    def numbers_left(self) -> int:
        """Numbers that belong to no part so far."""
        return self._stream.left

    def read(self, source: str, one: PackedPart, unloaded: bool = False) -> Part:
        """The next part, of a log of this name."""
        self._triangles += 1 + len(one.triangles) + len(one.noise_gram)
        if self._triangles > self._most:
            raise ValueError(f"more than {self._most} triangles")
        if len(one.state) != self._contacts or set(one.state) - {"0", "1"}:
            raise ValueError(f"contact state {one.state[:MAX_LETTERS]!r}")
        if max(one.masked, default=-1) >= self._extras or (unloaded and one.samples):
            raise ValueError("readings in the air of a sensor that is none")
        if not one.independent_rows <= one.rows or (one.rows and not one.independent_rows):
            raise ValueError(f"{one.independent_rows:g} independent of {one.rows} rows")
        triangles = {}
        for number, rows, packed in one.triangles:
            support = self._supports[number]
            triangles[support] = self._stream.triangle(len(support) + 1, rows, packed)
        noise_gram = {}
        for number in one.noise_gram:
            width = len(self._supports[number]) + 1
            half = self._stream.triangle(width, width, packed=True)
            noise_gram[self._supports[number]] = half + half.triu(1).T
        if len(triangles) != len(one.triangles) or len(noise_gram) != len(one.noise_gram):
            raise ValueError("the same columns twice")
        factor = TriangularFactor.from_blocks(self._columns, one.rows, one.independent_rows, triangles, noise_gram)
        state = tuple(digit == "1" for digit in one.state)
        return Part(source, state, factor, one.samples, unloaded=unloaded, masked=set(one.masked))


def _support(columns: Sequence[int], count: int) -> tuple[int, ...]:
    if len(set(columns)) != len(columns) or max(columns, default=0) >= count:
        raise ValueError(f"columns that are not among {count}")
    return tuple(columns)


class _Stream:
    """The numbers of all triangles, one after the other."""

    def __init__(self, values: Array) -> None:
        self._values, self._taken = values, 0

    @property
    def left(self) -> int:
        return len(self._values) - self._taken

    def triangle(self, width: int, rows: int, packed: bool) -> torch.Tensor:
        """The next triangle, or rows too few to make one, (rows, width); ValueError if there are not enough."""
        if rows > width or (packed and rows != width):
            raise ValueError(f"{rows} rows of {width} numbers")
        size = width * (width + 1) // 2 if packed else rows * width
        if size > self.left:
            raise ValueError("fewer numbers than are described")
        values = self._values[self._taken : self._taken + size]
        self._taken += size
        if not packed:
            return torch.from_numpy(values.reshape(rows, width).copy())
        triangle = np.zeros((width, width))
        triangle[np.triu_indices(width)] = values
        return torch.from_numpy(triangle)
