"""Nominal parameters of every body: the URDF's inertials, lumped, and its joint friction."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from yourdfpy.urdf import Inertial, Link

from torchid import parameters
from torchid.errors import UnphysicalInertiaWarning
from torchid.parameters import Array
from torchid.robot.tree import BodyTree

_TRIANGLE_TOLERANCE = 1e-3  # URDFs carry few digits: thin plates break the inequality by rounding alone
_ROUNDING = 1e-6  # of the largest principal inertia
_POINT = 1e-12  # [m^2]: below it a point mass is meant


def nominal_parameters(path: Path, tree: BodyTree, links: dict[str, Link]) -> Array:
    """Parameters (L, 12) of the bodies, each in its link frame.

    Warns:
        UnphysicalInertiaWarning: a link's inertia belongs to no distribution of positive mass.
    """
    nominal = np.zeros((len(tree.names), parameters.PER_BODY))
    for name, (body, T_body_link) in tree.links.items():
        inertial = links[name].inertial
        if inertial is None:
            continue
        _warn_if_unphysical(path, name, inertial)
        T_link_com = np.eye(4) if inertial.origin is None else inertial.origin
        at_com = parameters.inertial_vector(inertial.mass, np.zeros(3), inertial.inertia)
        nominal[body, parameters.INERTIAL] += parameters.change_of_frame(T_body_link @ T_link_com) @ at_com
    for body, joint in enumerate(tree.joints):
        if joint is not None:
            nominal[body, parameters.FRICTION] = joint.friction, joint.damping
    return nominal


def _warn_if_unphysical(path: Path, link: str, inertial: Inertial) -> None:
    small, middle, large = np.linalg.eigvalsh(inertial.inertia)
    if large == small == inertial.mass == 0.0:
        return
    if inertial.mass == 0.0:
        what = "mass 0 kg with an inertia that is not 0"
    elif small < -_ROUNDING * large - _POINT * inertial.mass:
        what = f"principal inertias {small:.3g}, {middle:.3g}, {large:.3g} kg m^2 are not all positive"
    elif large > (small + middle) * (1.0 + _TRIANGLE_TOLERANCE) + _POINT * inertial.mass:
        what = f"largest principal inertia {large:.3g} exceeds the sum of the others, {small + middle:.3g} kg m^2"
    else:
        return
    warnings.warn(f"{path}: link '{link}': {what}; used as written", UnphysicalInertiaWarning, stacklevel=5)
