"""A machine with force/torque sensors in its limbs, and real robots that carry some."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from synthetic import BAXTER, G1, PANDA, SOLO12, TALOS, TIAGO, TIAGO_PRO
from urdfs import inertial, joint, link, write

from torchid.sensing import Contact

SENSORS = ("mount_ft", "thigh_ft", "ankle_ft", "tail_ft")
"""Of `machine`: at the base, above a knee, below it, and beyond a joint that mimics another."""

CONTACTS = (Contact("sole", "flat"), Contact("thigh", "point"), Contact("fin", "line", "z"))
"""Of `machine`: beyond, before and between sensors."""
STATES = [[True, False, False], [False, True, True], [True, True, True], [False, False, False]]

REAL = {
    "wrist and sole of Talos": (TALOS, ("wrist_right_ft_joint", "leg_left_sole_fix_joint")),
    "palms of G1": (G1, ("left_hand_palm_joint", "right_hand_palm_joint")),
    "head and palm of G1": (G1, ("head_joint", "right_hand_palm_joint")),
    "Panda's hand above its fingers": (PANDA, ("panda_hand_joint",)),
    "two in each arm of Baxter": (BAXTER, ("left_torso_arm_mount", "left_w0_fixed", "left_hand_joint")),
    "TIAGo Pro's wrist above mimic fingers": (TIAGO_PRO, ("gripper_left_base_joint",)),
    "feet of Solo": (SOLO12, ("FL_ANKLE", "HR_ANKLE")),
    "torso and wrist of TIAGo": (TIAGO, ("torso_fixed_joint", "wrist_ft_joint", "wrist_tool_joint")),
}
"""Fixed joints of real robots."""


def machine(folder: Path, seed: int = 0) -> Path:
    """A leg with a slide for a knee, an arm without stops, a tail that mimics the hip; all is skew.

    Links: trunk, hips beyond a weld, thigh, shin beyond a weld, foot, sole beyond a weld, tail, fin beyond a weld and
    hand.
    """
    rng = np.random.default_rng(seed)

    def numbers(low: float, high: float, count: int = 3) -> str:
        return " ".join(map(repr, rng.uniform(low, high, count).tolist()))

    def body(name: str) -> str:
        moments = rng.uniform(0.2, 0.3, 3)
        turned = f'<origin xyz="{numbers(-0.2, 0.2)}" rpy="{numbers(-1.5, 1.5)}"/>'
        diagonal = dict(zip(("ixx", "iyy", "izz"), map(str, moments), strict=True))
        mass = str(rng.uniform(1.0, 4.0))
        return link(name, inertial(mass, turned, **diagonal, ixy="0.01", ixz="-0.02", iyz="0.03"))

    def placed(name: str, parent: str, child: str, kind: str = "revolute", extra: str = "") -> str:
        origin = f'<origin xyz="{numbers(-0.3, 0.3)}" rpy="{numbers(-1.5, 1.5)}"/>'
        axis = "" if kind == "fixed" else f'<axis xyz="{numbers(0.2, 1.0)}"/>'
        limit = '<limit lower="-9" upper="9" effort="9" velocity="9"/>'
        return joint(name, parent, child, kind, origin + axis + limit + extra)

    names = ("trunk", "hips", "thigh", "shin", "foot", "sole", "tail", "fin", "hand")
    return write(
        folder,
        *map(body, names),
        placed("mount_ft", "trunk", "hips", "fixed"),
        placed("hip", "hips", "thigh"),
        placed("thigh_ft", "thigh", "shin", "fixed"),
        placed("knee", "shin", "foot", "prismatic"),
        placed("ankle_ft", "foot", "sole", "fixed"),
        placed("tail_joint", "trunk", "tail", extra='<mimic joint="hip" multiplier="-1.3" offset="0.2"/>'),
        placed("tail_ft", "tail", "fin", "fixed"),
        placed("shoulder", "hips", "hand", "continuous"),
    )
