// Vectors in space and the motion of all joint frames, of as many samples as there are lanes.
#pragma once
#include "lanes.h"
#include <cmath>
#include <cstdint>
#include <vector>

using Int = std::int64_t;
using Lanes = V<double>;
constexpr Int TILE = LANES<double>; // samples of a tile

// Copied number by number: GCC copies a plain structure through memory.
struct Vector {
    Lanes x, y, z;
    Vector() : x{}, y{}, z{} {}
    Vector(const Lanes &x, const Lanes &y, const Lanes &z) : x(x), y(y), z(z) {}
    Vector(const Vector &v) : x(v.x), y(v.y), z(v.z) {}
    Vector &operator=(const Vector &v) {
        x = v.x, y = v.y, z = v.z;
        return *this;
    }
};
inline Vector operator+(const Vector &a, const Vector &b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator-(const Vector &a, const Vector &b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector operator*(const Lanes &s, const Vector &a) { return {s * a.x, s * a.y, s * a.z}; }
inline Lanes dot(const Vector &a, const Vector &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(const Vector &a, const Vector &b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// A rotation matrix: its columns, which are a frame's axes in the base frame.
struct Rotation {
    Vector x, y, z;
};
inline Vector turn(const Rotation &R, const Vector &v) { return v.x * R.x + v.y * R.y + v.z * R.z; }
inline Vector turn_back(const Rotation &R, const Vector &v) { return {dot(R.x, v), dot(R.y, v), dot(R.z, v)}; }
inline Vector turn(const Rotation &R, double x, double y, double z) {
    return turn(R, {fill(x), fill(y), fill(z)});
}

// A wrench at the base origin (force, moment) or a screw axis there (linear, angular velocity).
struct Spatial {
    Vector linear, angular;
};
inline Spatial operator+(const Spatial &a, const Spatial &b) { return {a.linear + b.linear, a.angular + b.angular}; }
inline Spatial operator*(const Lanes &s, const Spatial &a) { return {s * a.linear, s * a.angular}; }
inline Lanes dot(const Spatial &a, const Spatial &b) { return dot(a.linear, b.linear) + dot(a.angular, b.angular); }

inline Lanes square_root(Lanes x) {
    for (Int t = 0; t < TILE; ++t) x[t] = std::sqrt(x[t]);
    return x;
}

// Cosine and sine of a joint's angle, the position of a prismatic joint [m], velocity, acceleration, friction's sign.
enum JointRow { COSINE, SINE, SLIDE, VELOCITY, ACCELERATION, DIRECTION, JOINT_ROWS };

// Motion of a chunk, as `torchid.problem.compiled_rows` passes it: nodes come after their parents, node 0 is the base.
struct Motion {
    Int nodes, tiles;     // L, T
    const Int *parent;    // (L,)
    const double *pose;   // (L, 3, 4) in the parent's frame at position 0 [m]
    const double *slides; // (L,), 1 where the joint is prismatic, else 0
    const double *joints; // (T, L, JOINT_ROWS, TILE), see `JointRow`
    const double *base;   // (T, 9, TILE): angular velocity [rad/s] and acceleration [rad/s^2], specific force [m/s^2]

    Lanes joint(Int row, Int node, Int tile) const {
        return load(joints + ((tile * nodes + node) * JOINT_ROWS + row) * TILE);
    }
    Vector of_base(Int row, Int tile) const {
        const double *at = base + (tile * 9 + row) * TILE;
        return {load(at), load(at + TILE), load(at + 2 * TILE)};
    }
};

// State of a joint frame in base axes, as `torchid.regressor.kinematics.body_states` gives it.
struct State {
    Rotation rotation;
    Vector position, omega, alpha, force; // [m], [rad/s], [rad/s^2], specific force of the origin [m/s^2]
    Spatial screw;                        // the joint's axis, as of `joint_screw_axes`
};

// Write the states of all nodes at the samples of a tile.
inline void write_states(const Motion &motion, Int tile, State *states) {
    states[0] = State{};
    states[0].rotation.x.x = states[0].rotation.y.y = states[0].rotation.z.z = fill(1.0);
    states[0].omega = motion.of_base(0, tile);
    states[0].alpha = motion.of_base(3, tile);
    states[0].force = motion.of_base(6, tile);
    for (Int node = 1; node < motion.nodes; ++node) {
        const State &before = states[motion.parent[node]];
        const double *pose = motion.pose + 12 * node;
        const Vector x = turn(before.rotation, pose[0], pose[4], pose[8]);
        const Vector y = turn(before.rotation, pose[1], pose[5], pose[9]);
        const Vector axis = turn(before.rotation, pose[2], pose[6], pose[10]);
        const Lanes cosine = motion.joint(COSINE, node, tile), sine = motion.joint(SINE, node, tile);
        const Vector velocity = motion.joint(VELOCITY, node, tile) * axis;
        const Vector acceleration = motion.joint(ACCELERATION, node, tile) * axis;
        State &state = states[node];
        state.rotation = {cosine * x + sine * y, cosine * y - sine * x, axis};
        const Vector step = turn(before.rotation, pose[3], pose[7], pose[11]) + motion.joint(SLIDE, node, tile) * axis;
        state.position = before.position + step;
        state.omega = before.omega;
        state.alpha = before.alpha;
        state.force = before.force + cross(before.alpha, step);
        Vector swept = cross(before.omega, step); // velocity of the origin relative to the parent's
        if (motion.slides[node] != 0.0) {
            swept = swept + fill(2.0) * velocity;
            state.force = state.force + acceleration;
            state.screw = Spatial{axis, Vector{}};
        } else {
            state.omega = state.omega + velocity;
            state.alpha = state.alpha + cross(before.omega, velocity) + acceleration;
            state.screw = {cross(state.position, axis), axis};
        }
        state.force = state.force + cross(before.omega, swept);
    }
}
