"""Write the demo URDF and logs of the package: a quadruped that sways and lifts its feet in turn.

    python scripts/make_demo.py

Needs the package pin (extra `[oracle]`). The true robot is not the URDF's: mass, centre of mass and inertia of every
body are off by up to 30 %, joints have friction, and the recorded signals are noisy. The trunk leans away from each
foot before it lifts, so that in all samples every foot that is loaded pushes, within a friction cone of coefficient
0.6; a motion in which one would pull or slip is refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

FOLDER = Path(__file__).resolve().parents[1] / "torchid" / "demo"
LEGS = ("front_left", "front_right", "rear_left", "rear_right")
RATE_HZ = 100.0
TORQUE_NOISE, FORCE_NOISE, ANGLE_NOISE, POSITION_NOISE = 0.1, 0.5, 2e-5, 1e-5  # N m, N, rad, m
STEP_S, LIFT_M, UNLOADED = 1.6, 0.06, 0.3  # a foot is unloaded at 30 % of its lift
COULOMB, VISCOUS = 0.3, 0.05  # N m, N m s/rad
GROUND_FRICTION = 0.6  # tangential over normal force of a foot, at most
HEADING = Rotation.from_euler("z", 0.4)
STANCE = np.array([[x, y, 0.0] for x in (0.25, -0.25) for y in (0.18, -0.18)])  # feet, from below the trunk [m]
LEAN_M = np.array([0.065, 0.06, 0.0])  # of the trunk, away from the foot that lifts


def _link(name: str, mass: float, com: tuple[float, ...], box: tuple[float, ...]) -> str:
    x, y, z = box
    inertia = [mass / 12.0 * (a * a + b * b) for a, b in ((y, z), (x, z), (x, y))]
    return (
        f'  <link name="{name}">\n    <inertial>\n      <origin xyz="{com[0]} {com[1]} {com[2]}"/>\n'
        f'      <mass value="{mass}"/>\n      <inertia ixx="{inertia[0]:.6g}" ixy="0" ixz="0" '
        f'iyy="{inertia[1]:.6g}" iyz="0" izz="{inertia[2]:.6g}"/>\n    </inertial>\n  </link>\n'
    )


def _joint(name: str, kind: str, parent: str, child: str, xyz: tuple[float, ...], axis: str = "0 1 0") -> str:
    moving = f'\n    <axis xyz="{axis}"/>\n    <limit lower="-3" upper="3" effort="60" velocity="20"/>'
    return (
        f'  <joint name="{name}" type="{kind}">\n    <parent link="{parent}"/>\n    <child link="{child}"/>\n'
        f'    <origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}"/>{moving if kind != "fixed" else ""}\n  </joint>\n'
    )


def quadruped_urdf() -> str:
    """A twelve-joint quadruped of 21 kg with point feet."""
    parts = [
        '<?xml version="1.0"?>\n<robot name="demo_quadruped">\n',
        _link("trunk", 11.0, (0.01, 0, 0.02), (0.5, 0.2, 0.15)),
    ]
    for leg in LEGS:
        x, y = (0.22 if "front" in leg else -0.22), (0.09 if "left" in leg else -0.09)
        side = np.sign(y)
        parts += [
            _joint(f"{leg}_hip", "revolute", "trunk", f"{leg}_hip_link", (x, y, 0.0), "1 0 0"),
            _link(f"{leg}_hip_link", 0.9, (0.0, side * 0.03, 0.0), (0.1, 0.08, 0.1)),
            _joint(f"{leg}_thigh", "revolute", f"{leg}_hip_link", f"{leg}_thigh_link", (0.0, side * 0.08, 0.0)),
            _link(f"{leg}_thigh_link", 1.2, (-0.01, 0.0, -0.08), (0.06, 0.05, 0.26)),
            _joint(f"{leg}_knee", "revolute", f"{leg}_thigh_link", f"{leg}_shank_link", (0.0, 0.0, -0.24)),
            _link(f"{leg}_shank_link", 0.35, (0.0, 0.0, -0.1), (0.04, 0.04, 0.24)),
            _joint(f"{leg}_sole", "fixed", f"{leg}_shank_link", f"{leg}_foot", (0.0, 0.0, -0.24)),
            f'  <link name="{leg}_foot"/>\n',
        ]
    return "".join([*parts, "</robot>\n"])


def base_motion(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, Rotation]:
    """Smooth sway of the trunk, and its lean away from the foot that lifts: position (N, 3) and orientation."""

    def sway(size: float) -> np.ndarray:
        rates, phases = rng.uniform(0.3, 1.6, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        return size * np.sin(2.0 * np.pi * time[:, None] * rates + phases).sum(1)

    position = np.stack([sway(0.01), sway(0.01), 0.32 + sway(0.018)], axis=1)
    position -= turns(time, share=1.0) @ HEADING.apply(LEAN_M * np.sign(STANCE))
    return position, Rotation.from_rotvec(np.stack([sway(0.05), sway(0.07), 0.4 + sway(0.07)], axis=1))


def turns(time: np.ndarray, share: float) -> np.ndarray:
    """Each foot's turn, one after the other, (N, 4): from 0 to 1 and back in the middle share of its step."""
    phase = time / STEP_S
    turn = np.zeros((len(time), len(LEGS)))
    for leg in range(len(LEGS)):
        local = np.where(np.floor(phase).astype(int) % len(LEGS) == leg, phase % 1.0, 0.0)
        swing = np.clip((local - 0.5) / share + 0.5, 0.0, 1.0)
        turn[:, leg] = (np.sin(np.pi * swing) ** 4) * (swing > 0.0)
    return turn


def leg_angles(model: pin.Model, base: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Joint angles (N, 12) at which the feet have positions (N, 4, 3), by Newton's method."""
    data, names = model.createData(), [f"{leg}_foot" for leg in LEGS]
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in names]
    guess = np.tile([0.0, 0.7, -1.4], len(LEGS))
    angles = np.empty((len(base), guess.size))
    for sample, (pose, targets) in enumerate(zip(base, feet, strict=True)):
        for _ in range(20):
            q = np.concatenate([pose, guess])
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacements(model, data)
            errors = [target - data.oMf[frame].translation for frame, target in zip(frames, targets, strict=True)]
            J = np.vstack([pin.getFrameJacobian(model, data, f, pin.LOCAL_WORLD_ALIGNED)[:3, 6:] for f in frames])
            guess = guess + np.linalg.solve(J, np.concatenate(errors))
            if np.abs(errors).max() < 1e-12:
                break
        angles[sample] = guess
    return angles


def perturbed(model: pin.Model, rng: np.random.Generator) -> pin.Model:
    """The true robot: every body's mass, centre of mass and inertia off by up to 30 %, yet physical."""
    true = model.copy()
    for index in range(1, true.njoints):
        inertia = true.inertias[index]
        mass, com, spin = 1.0 + 0.3 * rng.uniform(-1.0, 1.0, 3)
        true.inertias[index] = pin.Inertia(mass * inertia.mass, com * inertia.lever, spin * mass * inertia.inertia)
    return true


def forces(
    model: pin.Model, q: np.ndarray, v: np.ndarray, a: np.ndarray, load: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joint torques (12,) and foot forces in the feet's axes (4, 3); feet share the load in proportion to `load`.

    Raises:
        ValueError: a foot would pull or slip.
    """
    data = model.createData()
    generalized = pin.rnea(model, data, q, v, a)
    frames = [model.getFrameId(f"{leg}_foot", pin.FrameType.BODY) for leg in LEGS]
    J = np.vstack([pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL)[:3] for frame in frames])
    share = np.repeat(load, 3)
    J_base = J[:, :6].T
    force = share * (J_base.T @ np.linalg.solve((J_base * share) @ J_base.T, generalized[:6]))
    pin.framesForwardKinematics(model, data, q)
    for leg, frame, local in zip(LEGS, frames, force.reshape(-1, 3), strict=True):
        *along, normal = data.oMf[frame].rotation @ local
        if np.hypot(*along) > GROUND_FRICTION * normal:
            raise ValueError(f"{leg}: {normal:.3g} N on the ground, {np.hypot(*along):.3g} N along it")
    friction = COULOMB * np.sign(v[6:]) + VISCOUS * v[6:]
    return generalized[6:] + friction - J[:, 6:].T @ force, force.reshape(-1, 3)


def record(model: pin.Model, true: pin.Model, seconds: float, rng: np.random.Generator, path: Path) -> None:
    """Simulate one log and save it."""
    time = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    position, rotation = base_motion(time, rng)
    height = turns(time, share=0.5)
    feet = HEADING.apply(STANCE)[None] + LIFT_M * height[..., None] * np.array([0.0, 0.0, 1.0])
    angles = leg_angles(model, np.hstack([position, rotation.as_quat()]), feet)

    spline = make_interp_spline(time, np.hstack([position, rotation.as_rotvec(), angles]), k=5)
    smooth = [spline.derivative(order)(time) if order else spline(time) for order in range(3)]
    load = np.clip(1.0 - height / UNLOADED, 0.0, 1.0) ** 2
    torque, wrench = np.empty_like(angles), np.zeros((len(time), len(LEGS), 6))
    for i in range(len(time)):
        q = np.concatenate([position[i], rotation[i].as_quat(), angles[i]])
        omega, alpha = body_rates(*(x[i, 3:6] for x in smooth))
        R = rotation[i].as_matrix()
        linear = R.T @ smooth[1][i, :3]
        v = np.concatenate([linear, omega, smooth[1][i, 6:]])
        a = np.concatenate([R.T @ smooth[2][i, :3] - np.cross(omega, linear), alpha, smooth[2][i, 6:]])
        torque[i], wrench[i, :, :3] = forces(true, q, v, a, load[i])
    active = load > 0.0
    wrench[..., :3] += FORCE_NOISE * rng.normal(size=wrench[..., :3].shape) * active[..., None]
    np.savez_compressed(
        path,
        time=time,
        joint_names=np.array([f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "knee")]),
        joint_position=np.round(angles + ANGLE_NOISE * rng.normal(size=angles.shape), 6),
        joint_torque=np.round(torque + TORQUE_NOISE * rng.normal(size=torque.shape), 3),
        base_position_world=np.round(position + POSITION_NOISE * rng.normal(size=position.shape), 6),
        base_quat_wxyz=np.round(rotation.as_quat()[:, [3, 0, 1, 2]], 7),
        contact_names=np.array([f"{leg}_foot" for leg in LEGS]),
        contact_active=active,
        contact_wrench_local=np.round(wrench, 2),
    )


def body_rates(vector: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocity and acceleration in body axes from a rotation vector and its derivatives."""

    def velocity(x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        return pin.Jexp3(x) @ dx

    step = 1e-5
    before = velocity(vector - step * rate + 0.5 * step**2 * acceleration, rate - step * acceleration)
    after = velocity(vector + step * rate + 0.5 * step**2 * acceleration, rate + step * acceleration)
    return velocity(vector, rate), (after - before) / (2.0 * step)


def main() -> None:
    """Write the URDF and two logs."""
    FOLDER.mkdir(exist_ok=True)
    urdf = FOLDER / "quadruped.urdf"
    urdf.write_text(quadruped_urdf())
    model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
    true = perturbed(model, np.random.default_rng(1))
    print(f"true mass {pin.computeTotalMass(true):.3f} kg, URDF {pin.computeTotalMass(model):.3f} kg")
    record(model, true, 13.0, np.random.default_rng(2), FOLDER / "sway_train.npz")
    record(model, true, 7.0, np.random.default_rng(3), FOLDER / "sway_test.npz")


if __name__ == "__main__":
    main()
