"""Small URDFs written by hand, and what loading them says."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import pytest
from refusals import refused

from torchid.errors import InputError, TorchidWarning, UrdfError
from torchid.robot import Robot, load_robot

INERTIA = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
INERTIAL = f'<inertial><mass value="1"/>{INERTIA}</inertial>'
BASE, ARM = f'<link name="base">{INERTIAL}</link>', f'<link name="arm">{INERTIAL}</link>'
ENDS = '<parent link="base"/><child link="arm"/>'
HINGE = f'<joint name="elbow" type="revolute">{ENDS}<axis xyz="0 0 1"/></joint>'


def link(name: str, inertial: str = INERTIAL) -> str:
    """A link element."""
    return f'<link name="{name}">{inertial}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = '<axis xyz="0 0 1"/>') -> str:
    """A joint element."""
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{extra}</joint>'


def write(folder: Path, *elements: str) -> Path:
    """A URDF of some elements."""
    path = folder / "machine.urdf"
    path.write_text(f'<?xml version="1.0"?><robot name="machine">{"".join(elements)}</robot>')
    return path


def inertial(mass: str = "1", origin: str = "", **numbers: str) -> str:
    """An inertial element; inertia numbers that are not given are 0.1 on the diagonal, else 0."""
    values = {"ixx": "0.1", "ixy": "0", "ixz": "0", "iyy": "0.1", "iyz": "0", "izz": "0.1"} | numbers
    attributes = " ".join(f'{name}="{value}"' for name, value in values.items())
    return f'<inertial>{origin}<mass value="{mass}"/><inertia {attributes}/></inertial>'


def words(numbers: Iterable[float]) -> str:
    """Numbers as an attribute holds them, to the last bit."""
    return " ".join(repr(float(x)) for x in numbers)


def ball(radius: float, tag: str = "visual") -> str:
    """A sphere about a link's origin, one of its shapes."""
    return f'<{tag}><geometry><sphere radius="{radius}"/></geometry></{tag}>'


def mimic(master: str, extra: str = "") -> str:
    """Content of a joint that follows another."""
    return f'<axis xyz="0 0 1"/><mimic joint="{master}" {extra}/>'


TREE = (BASE, ARM, HINGE)


def table(cases: dict) -> pytest.MarkDecorator:
    """A test per entry."""
    return pytest.mark.parametrize("case", cases.values(), ids=cases.keys())


def refusal(path: Path, kind: type[InputError] = UrdfError, base_link: str | None = None) -> str:
    """The one line that loading fails with."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        warnings.simplefilter("ignore", RuntimeWarning)  # yourdfpy turns angles into matrices before anyone can look
        return refused(lambda: load_robot(path, base_link), f"{path}: ", kind)


def warned(path: Path) -> tuple[Robot, list[warnings.WarningMessage]]:
    """The robot with what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return load_robot(path), caught
