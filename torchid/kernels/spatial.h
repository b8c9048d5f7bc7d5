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
template <class T> struct Vec {
    V<T> x, y, z;
    Vec() : x{}, y{}, z{} {}
    Vec(const V<T> &x, const V<T> &y, const V<T> &z) : x(x), y(y), z(z) {}
    Vec(const Vec &v) : x(v.x), y(v.y), z(v.z) {}
    Vec &operator=(const Vec &v) {
        x = v.x, y = v.y, z = v.z;
        return *this;
    }
    Vec operator+(const Vec &b) const { return {x + b.x, y + b.y, z + b.z}; }
    Vec operator-(const Vec &b) const { return {x - b.x, y - b.y, z - b.z}; }
    Vec operator*(const V<T> &s) const { return {x * s, y * s, z * s}; }
    void operator+=(const Vec &b) { x += b.x, y += b.y, z += b.z; }
    void operator-=(const Vec &b) { x -= b.x, y -= b.y, z -= b.z; }
};
template <class T> V<T> dot(const Vec<T> &a, const Vec<T> &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T> Vec<T> cross(const Vec<T> &a, const Vec<T> &b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T> Vec<T> constant(T x, T y, T z) { return {fill(x), fill(y), fill(z)}; }
template <class T> Vec<T> column(const T *pose, int k) { return constant(pose[k], pose[4 + k], pose[8 + k]); }

// The columns of a rotation matrix: a frame's axes in the base frame.
template <class T> struct Axes {
    Vec<T> x, y, z;
    Vec<T> out(const Vec<T> &v) const { return x * v.x + y * v.y + z * v.z; }       // to the base frame
    Vec<T> in(const Vec<T> &v) const { return {dot(x, v), dot(y, v), dot(z, v)}; } // from it
    // Add to the gradients of axes, given that of `out(v)` or `in(v)`.
    void out_grad(const Vec<T> &v, const Vec<T> &g) { x += g * v.x, y += g * v.y, z += g * v.z; }
    void in_grad(const Vec<T> &v, const Vec<T> &g) { x += v * g.x, y += v * g.y, z += v * g.z; }
};

// A wrench at the base origin (force, moment) or a screw axis there (linear, angular velocity).
template <class T> struct Screw {
    Vec<T> linear, angular;
    Screw operator+(const Screw &b) const { return {linear + b.linear, angular + b.angular}; }
    Screw operator*(const V<T> &s) const { return {linear * s, angular * s}; }
};
template <class T> V<T> dot(const Screw<T> &a, const Screw<T> &b) {
    return dot(a.linear, b.linear) + dot(a.angular, b.angular);
}

// State of a frame in base axes, as `torchid.regressor.kinematics.body_states` gives it.
template <class T> struct State {
    Axes<T> axes;
    Vec<T> position, omega, alpha, force; // [m], [rad/s], [rad/s^2], specific force of the origin [m/s^2]
};
template <class T> State<T> base_state() {
    State<T> out;
    out.axes.x.x = out.axes.y.y = out.axes.z.z = fill<T>(1);
    return out;
}

// Motion of a joint: of its angle, 0 if it slides; its position if it slides, else 0; [rad/s or m/s], [rad/s^2, m/s^2].
template <class T> struct Joint {
    V<T> cosine, sine, slide, velocity, acceleration;
};

// The state of a joint frame from that of the frame above. pose: (3, 4) in this at position 0 [m].
template <class T> State<T> moved(const State<T> &up, const T *pose, bool slides, const Joint<T> &joint) {
    State<T> out = up;
    const Vec<T> x = up.axes.out(column(pose, 0)), y = up.axes.out(column(pose, 1)), z = up.axes.out(column(pose, 2));
    out.axes = {x * joint.cosine + y * joint.sine, y * joint.cosine - x * joint.sine, z};
    const Vec<T> step = up.axes.out(column(pose, 3)) + z * joint.slide, velocity = z * joint.velocity;
    out.position += step;
    out.force += cross(up.alpha, step);
    Vec<T> swept = cross(up.omega, step); // velocity of the origin relative to the parent's
    if (slides) {
        swept += velocity * fill<T>(2);
        out.force += z * joint.acceleration;
    } else {
        out.omega += velocity;
        out.alpha += cross(up.omega, velocity) + z * joint.acceleration;
    }
    out.force += cross(up.omega, swept);
    return out;
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
    Vec<double> of_base(Int row, Int tile) const {
        const double *at = base + (tile * 9 + row) * TILE;
        return {load(at), load(at + TILE), load(at + 2 * TILE)};
    }
};

// State of a joint frame, and the joint's axis as of `joint_screw_axes`.
struct Node : State<double> {
    Screw<double> screw;
};

// Write the states of all nodes at the samples of a tile.
inline void write_states(const Motion &motion, Int tile, Node *states) {
    static_cast<State<double> &>(states[0]) = base_state<double>();
    states[0].omega = motion.of_base(0, tile);
    states[0].alpha = motion.of_base(3, tile);
    states[0].force = motion.of_base(6, tile);
    for (Int node = 1; node < motion.nodes; ++node) {
        const auto row = [&](Int k) { return motion.joint(k, node, tile); };
        const Joint<double> joint = {row(COSINE), row(SINE), row(SLIDE), row(VELOCITY), row(ACCELERATION)};
        const bool slides = motion.slides[node] != 0.0;
        Node &own = states[node];
        static_cast<State<double> &>(own) = moved<double>(states[motion.parent[node]], motion.pose + 12 * node, slides, joint);
        if (slides)
            own.screw = {own.axes.z, {}};
        else
            own.screw = {cross(own.position, own.axes.z), own.axes.z};
    }
}
