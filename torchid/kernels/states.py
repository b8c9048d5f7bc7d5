"""States of all joint frames, tile by tile: what `torchid.regressor.kinematics.body_states` gives, node after node."""

from __future__ import annotations

from torchid.kernels.tiles import (
    ARRAY,
    INDEX,
    TILE,
    Index,
    add,
    compiled,
    cross,
    dot,
    load,
    store,
    times,
    turn,
)
from torchid.parameters import Array

POSITION, OMEGA, ALPHA, FORCE, SCREW = 9, 12, 15, 18, 21
"""Where the parts of a state are: the rotation first, by rows, then these; the screw axis has six numbers."""
STATE = 27
"""Numbers of a state."""

COSINE, SINE, SLIDE, VELOCITY, ACCELERATION, DIRECTION = range(6)
"""What `joints` has of each joint: of its angle, its position if it slides, else 0, and the rest of its motion."""


@compiled()
def _move(before: Array, own: Array, pose: Array, cosine: Array, sine: Array, slide: Array) -> None:
    """Write the pose of a node."""
    for t in range(TILE):
        x = turn(before, t, (pose[0], pose[4], pose[8]))
        y = turn(before, t, (pose[1], pose[5], pose[9]))
        z = turn(before, t, (pose[2], pose[6], pose[10]))
        step = turn(before, t, (pose[3], pose[7], pose[11]))
        c, s = cosine[t], sine[t]
        for i in range(3):
            store(own, 3 * i, t, (c * x[i] + s * y[i], c * y[i] - s * x[i], z[i]))
        store(own, POSITION, t, add(load(before, POSITION, t), add(step, times(slide[t], z))))


@compiled()
def _accelerate(before: Array, own: Array, slides: float, velocity: Array, acceleration: Array) -> None:
    """Write the angular velocity and acceleration of a node, and its specific force."""
    turns = 1.0 - slides
    for t in range(TILE):
        axis = own[2 * TILE + t], own[5 * TILE + t], own[8 * TILE + t]
        omega, alpha = load(before, OMEGA, t), load(before, ALPHA, t)
        step = add(load(own, POSITION, t), times(-1.0, load(before, POSITION, t)))
        turned, slid = times(turns * velocity[t], axis), times(2.0 * slides * velocity[t], axis)
        store(own, OMEGA, t, add(omega, turned))
        store(own, ALPHA, t, add(add(alpha, cross(omega, turned)), times(turns * acceleration[t], axis)))
        force = add(cross(alpha, step), cross(omega, add(cross(omega, step), slid)))
        force = add(force, times(slides * acceleration[t], axis))
        store(own, FORCE, t, add(load(before, FORCE, t), force))


@compiled()
def _write_screw_axis(own: Array, slides: float) -> None:
    """Write what `joint_screw_axes` gives."""
    turns = 1.0 - slides
    for t in range(TILE):
        axis = own[2 * TILE + t], own[5 * TILE + t], own[8 * TILE + t]
        linear = add(times(turns, cross(load(own, POSITION, t), axis)), times(slides, axis))
        store(own, SCREW, t, linear)
        store(own, SCREW + 3, t, times(turns, axis))


@compiled()
def power(screw: Array, wrench: Array, t: int) -> float:
    """Of a wrench at the base origin and a screw axis, both of them six numbers of a tile."""
    return dot(load(screw, 0, t), load(wrench, 0, t)) + dot(load(screw, 3, t), load(wrench, 3, t))


@compiled(INDEX, ARRAY, ARRAY, ARRAY, ARRAY, ARRAY)
def write_states(parent: Index, pose: Array, slides: Array, joints: Array, base: Array, states: Array) -> None:
    """Write the states of all nodes at P samples, a multiple of `TILE`.

    Args:
        parent: (L,), node above each node; nodes are in an order in which it comes first.
        pose: (L, 3, 4) at position 0 in its frame, flat as all that follow.
        slides: (L,), 1 where the joint is prismatic, else 0.
        joints: (6, L, P).
        base: (9, P), angular velocity and acceleration, specific force.
        states: (P / TILE, L, STATE, TILE), is written.
    """
    nodes, samples = len(parent), len(base) // 9
    row, size = nodes * samples, STATE * TILE
    for tile in range(samples // TILE):
        start = tile * TILE
        own = states[tile * nodes * size : (tile * nodes + 1) * size]
        own[:] = 0.0
        for k in (0, 4, 8):
            own[k * TILE : (k + 1) * TILE] = 1.0
        for k in range(9):
            own[(OMEGA + k) * TILE : (OMEGA + k + 1) * TILE] = base[k * samples + start : k * samples + start + TILE]
        for node in range(1, nodes):
            at, above = (tile * nodes + node) * size, (tile * nodes + parent[node]) * size
            own, before = states[at : at + size], states[above : above + size]
            at = node * samples + start
            cosine, sine = joints[at : at + TILE], joints[SINE * row + at : SINE * row + at + TILE]
            slide = joints[SLIDE * row + at : SLIDE * row + at + TILE]
            _move(before, own, pose[12 * node : 12 * (node + 1)], cosine, sine, slide)
            velocity = joints[VELOCITY * row + at : VELOCITY * row + at + TILE]
            acceleration = joints[ACCELERATION * row + at : ACCELERATION * row + at + TILE]
            _accelerate(before, own, slides[node], velocity, acceleration)
            _write_screw_axis(own, slides[node])
