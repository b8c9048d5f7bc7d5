"""The robots: what they are, how they move, and what is wrong with their logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from legged.robots import G1, GO2, Legged

from defaults.sensors import Flaws
from defaults.truth import ROBOTS as _EXAMPLES
from defaults.truth import Payload, serial_arm

_FOLDER = _EXAMPLES / "robots"
Range = tuple[float, float]


@dataclass(frozen=True)
class Held:
    """How a robot whose base is held moves.

    Attributes:
        posture: of joints by the end of their names, others in the middle of their range [rad].
        reach: of a joint's half range, at most `widest` [rad].
        hz: band of the motion; that of the unseen log reaches `faster` times as far.
        friction, armature: ranges of Coulomb and viscous friction and of the armature, of the strongest joints.
    """

    posture: Mapping[str, float] = field(default_factory=dict)
    reach: float = 0.6
    widest: float = 0.9
    hz: Range = (0.05, 0.5)
    faster: float = 1.2
    friction: tuple[Range, Range] = ((0.3, 1.2), (0.1, 0.8))
    armature: Range = (0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """A simulated robot.

    Attributes:
        urdf: the given one, a file or its text.
        moves: held, or on feet.
        flaws: of its logs.
        integrator: of MuJoCo; None: inverse dynamics along a prescribed motion, with explicit Coulomb friction.
        floor: time constant of the contacts [s], in MuJoCo.
        payload: what the given URDF lacks.
        imu: its frame, of robots on feet.
        rate: of the logs [Hz].
        seconds: of the log and of the unseen one.
        edit: what the user of a held robot states, where the defaults do not find it.
    """

    urdf: Path | str
    moves: Held | Legged
    flaws: Flaws = Flaws()
    integrator: str | None = None
    floor: float = 0.008
    payload: Payload | None = None
    imu: str = ""
    rate: float = 500.0
    seconds: Range = (40.0, 20.0)
    edit: tuple[str, ...] = ()


_TROT = GO2.lifted
_STAND = (
    "robot.fixed_base=true",
    "contacts=[]",
    "preprocessing.base_motion=null",
    "preprocessing.detect_contacts=false",
)


def _knees(thigh: float, knee: float, names: str, front: Sequence[str], hind: Sequence[str]) -> dict[str, float]:
    """A posture of four legs whose knees point at each other; `names`: of joints, with a place for that of the leg."""
    signs = {**dict.fromkeys(front, 1.0), **dict.fromkeys(hind, -1.0)}
    angles = dict(zip(names.split(), (thigh, knee), strict=True))
    return {name.format(leg): sign * angle for leg, sign in signs.items() for name, angle in angles.items()}


_ANYMAL = Legged(
    "anymal",
    _FOLDER / "anymal_b_simple_description/robots/anymal.urdf",
    ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"),
    "point",
    ((0.0, 0.0, 0.02325),),
    0.031,
    _knees(0.6, -1.2, "{}_HFE {}_KFE", ("LF", "RF"), ("LH", "RH")),
    _TROT,
    lift=0.07,
    sway=0.025,
    friction=((0.4, 1.2), (0.1, 0.4)),
    armature=(0.0, 0.0),
    gains=(600.0, 10.0),
)
_A1 = Legged(
    "a1",
    _FOLDER / "a1_description/urdf/a1.urdf",
    ("FR_foot", "FL_foot", "RR_foot", "RL_foot"),
    "point",
    radius=0.02,
    posture={
        f"{leg}_{name}_joint": x for leg in ("FR", "FL", "RR", "RL") for name, x in (("thigh", 0.8), ("calf", -1.6))
    },
    lifted=_TROT,
    armature=(0.005, 0.015),
)
_SOLO = Legged(
    "solo12",
    _FOLDER / "solo_description/robots/solo12.urdf",
    ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"),
    "point",
    radius=0.015,
    posture=_knees(0.7, -1.4, "{}_HFE {}_KFE", ("FL", "FR"), ("HL", "HR")),
    lifted=_TROT,
    lift=0.03,
    sway=0.012,
    friction=((0.02, 0.06), (0.005, 0.02)),
    armature=(0.0006, 0.0012),
    gains=(40.0, 0.8),
)
_HYQ = Legged(
    "hyq",
    _FOLDER / "hyq_description/robots/hyq_no_sensors.urdf",
    ("lf_foot", "rf_foot", "lh_foot", "rh_foot"),
    "point",
    radius=0.02175,
    posture=_knees(0.75, -1.5, "{}_hfe_joint {}_kfe_joint", ("lf", "rf"), ("lh", "rh")),
    lifted=_TROT,
    lift=0.08,
    sway=0.03,
    friction=((1.0, 4.0), (0.5, 2.0)),
    armature=(0.02, 0.08),
    gains=(2500.0, 40.0),
)
_BIPED = Legged(
    "biped",
    Path(__file__).parents[2] / "configs/biped.urdf",
    ("l_sole", "r_sole"),
    "flat",
    ((-0.11, 0.05, 0.01), (-0.11, -0.05, 0.01), (0.11, 0.05, 0.01), (0.11, -0.05, 0.01)),
    0.01,
    {
        f"{leg}_{name}": x
        for leg in "lr"
        for name, x in (("hip_flexion", -0.5), ("knee_flexion", 1.0), ("ankle_flexion", -0.5))
    },
    ((0,), (1,)),
    swing=0.6,
    both=0.9,
    lift=0.04,
    sway=0.012,
    waving=0.2,
    friction=((0.5, 2.0), (0.1, 0.5)),
    armature=(0.0, 0.0),
    gains=(4000.0, 60.0),
)

CASES: dict[str, Case] = {
    "panda": Case(
        _FOLDER / "panda_description/urdf/panda.urdf",
        Held({"joint4": -1.6, "joint6": 1.7}, armature=(0.05, 0.25)),
        Flaws(offset=0.3, delay=(0.002, 0.008), encoder=2e-5, velocity=0.004),
        rate=250.0,
    ),
    "arm3": Case(
        serial_arm("arm3", (0.3, 0.35, 0.25), (5.0, 3.0, 1.2), "zyy"),
        Held(hz=(0.1, 0.9), friction=((0.2, 0.6), (0.1, 0.5))),
        Flaws(ringing="strong", encoder=2e-6, velocity=0.002),
    ),
    "ur5": Case(
        _FOLDER / "ur_description/urdf/ur5_robot.urdf",
        Held(
            {"lift_joint": -1.2, "elbow_joint": 1.3, "wrist_1_joint": -0.8, "wrist_2_joint": 0.7},
            widest=1.1,
            friction=((2.0, 6.0), (2.0, 8.0)),
            armature=(0.3, 0.9),
        ),
        Flaws(torque_noise=0.04, delay=(0.0, 0.015), ringing="mild", band=(8.0, 30.0), encoder=5e-5),
        payload=Payload("wrist_3_link", (0.8, 1.8)),
        rate=125.0,
    ),
    "kuka7": Case(
        serial_arm("kuka7", (0.3, 0.2, 0.2, 0.2, 0.2, 0.1, 0.1), (4.0, 4.0, 3.0, 2.7, 1.7, 1.8, 0.4), "zyzyzyz"),
        Held(reach=0.4, hz=(0.05, 0.4), friction=((0.2, 0.8), (0.1, 0.4))),
        Flaws(offset=0.2, ringing="strong", band=(5.0, 25.0), encoder=1e-5, velocity=None),
        payload=Payload("l7", (0.5, 1.5)),
    ),
    "z1": Case(
        _FOLDER / "z1_description/urdf/z1.urdf",
        Held({"joint2": 1.2, "joint3": -1.2}, friction=((0.3, 1.0), (0.1, 0.6)), armature=(0.01, 0.05)),
        Flaws(ringing="mild", band=(20.0, 80.0), encoder=1e-4, velocity=0.01, lag=0.003),
        integrator="implicitfast",
    ),
    "go2_stand": Case(
        GO2.urdf,
        Held(
            GO2.posture,
            reach=0.5,
            widest=0.45,
            hz=(0.2, 2.0),
            friction=((0.1, 0.5), (0.05, 0.2)),
            armature=(0.006, 0.02),
        ),
        Flaws(delay=(0.006, 0.015), torque_noise=0.04, encoder=4e-4, velocity=0.05),
        rate=250.0,
        edit=_STAND,
    ),
    "anymal_stand": Case(
        _ANYMAL.urdf,
        Held(_ANYMAL.posture, reach=0.5, widest=0.5, hz=(0.1, 1.0), friction=_ANYMAL.friction, armature=(0.0, 0.05)),
        Flaws(offset=0.1, ringing="mild", band=(15.0, 50.0), encoder=2e-4, velocity=0.02),
        integrator="implicit",
        edit=_STAND,
    ),
    "anymal_walk": Case(
        _ANYMAL.urdf,
        _ANYMAL,
        Flaws(encoder=2e-4, velocity=0.03),
        integrator="implicitfast",
        payload=Payload("base", (1.5, 4.0), 0.15),
        imu="imu_link",
    ),
    "go2_walk": Case(
        GO2.urdf,
        GO2,
        Flaws(delay=(0.002, 0.010), torque_noise=0.03, encoder=4e-4, velocity=0.05),
        integrator="euler",
        floor=0.02,
        imu="imu",
        rate=250.0,
    ),
    "a1_walk": Case(
        _A1.urdf,
        _A1,
        Flaws(offset=0.05, ringing="mild", band=(25.0, 80.0), encoder=4e-4, velocity=0.05),
        integrator="implicit",
        imu="imu_link",
        payload=Payload("trunk", (0.5, 2.0), 0.1),
    ),
    "hyq_walk": Case(
        _HYQ.urdf,
        _HYQ,
        Flaws(torque_noise=0.03, ringing="strong", band=(20.0, 60.0), encoder=1e-4, velocity=None),
        integrator="implicitfast",
        imu="trunk_imu",
    ),
    "solo12_steps": Case(
        _SOLO.urdf,
        _SOLO,
        Flaws(delay=(0.0, 0.004), torque_noise=0.05, encoder=3e-4, velocity=0.05),
        imu="base_link",
    ),
    "g1_stand": Case(
        G1.urdf,
        replace(G1, lifted=(), sway=0.02, waving=0.3),
        Flaws(encoder=1e-4, velocity=0.02),
        imu="imu_in_pelvis",
        rate=250.0,
        seconds=(30.0, 15.0),
    ),
    "g1_walk": Case(
        G1.urdf,
        G1,
        Flaws(torque_noise=0.03, delay=(0.002, 0.006), encoder=2e-4, velocity=0.04),
        integrator="implicitfast",
        floor=0.004,
        payload=Payload("torso_link", (1.0, 3.0), 0.1),
        imu="imu_in_pelvis",
        rate=250.0,
        seconds=(30.0, 15.0),
    ),
    "biped_steps": Case(
        _BIPED.urdf,
        _BIPED,
        Flaws(offset=0.05, ringing="mild", band=(10.0, 40.0), encoder=1e-4, velocity=0.02),
        imu="pelvis",
        rate=250.0,
        seconds=(30.0, 15.0),
    ),
}
