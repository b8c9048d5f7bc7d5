// Regressor, inverse dynamics, frame Jacobians and their gradients: 8 doubles or 16 floats of as many samples at a time.
//
// A screw (l, m) is seen from a body: a row of the dynamics feels the wrench (F, M) of a body, in the body's axes about
// its origin, as l . F + m . M. Every row of K, every torque and every column of a frame Jacobian is made of screws.
// The functions that end with _grad add to the gradients of their arguments. torchid.regressor.kinematics has the
// equations for people.

#include "spatial.h"
#include "threads.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

using Index = Int;
constexpr Index GROUPS = 4; // groups of lanes that take turns at each row: their results lie side by side in memory

template <class T> Vec<T> zero() { return {}; }

template <class T> struct Link { // constants of a node, all as in torchid.regressor.tree.KinematicTree
    Index parent, slides, dof, moves, framed, first_term, terms;
    const Index *columns; // of its ten inertial parameters, fc and fv in K; -1 where there is none
    const T *pose, *link; // (3, 4) each: at position 0 in the parent's frame; of the link frame in its own
    T ratio, offset;
};

struct Term {               // a row of the dynamics and a node whose joint moves it; -1 for the base
    Index row, joint, more; // more: whether the next term adds to the same row
};

template <class T> struct Robot {
    Index n, base, dofs, columns, rows, size_q, size_v;
    std::vector<Link<T>> nodes;
    const Term *terms;
    const T *gravity;
    T width;

    Robot(const Index *table, const T *reals) {
        const Index count = table[0];
        n = table[1], base = table[2], dofs = table[3], columns = table[4], rows = base + dofs;
        size_q = n + (base ? 7 : 0), size_v = n + base;
        gravity = reals, width = reals[3];
        terms = reinterpret_cast<const Term *>(table + 5 + 19 * count);
        for (Index i = 0; i < count; ++i) {
            const Index *x = table + 5 + 19 * i;
            const T *y = reals + 4 + 26 * i;
            nodes.push_back({x[0], x[1], x[2], x[3], x[4], x[5], x[6], x + 7, y, y + 12, y[24], y[25]});
        }
    }
};

// The first numbers of some lanes to places that lie `step` apart
template <class T> void scatter(const V<T> &x, T *to, Index step, Index count) {
    for (Index k = 0; k < count && k < LANES<T>; ++k) to[k * step] = x[k];
}

template <class T> struct Input { // rows of samples, those of a group of lanes from `first` on
    const T *data;
    Index width, first, count;
    V<T> operator[](Index k) const { return gather(data + first * width + k, width, count); }
    Vec<T> vec(Index k) const { return {(*this)[k], (*this)[k + 1], (*this)[k + 2]}; }
};
template <class T> struct Output {
    T *data;
    Index width, first, count;
    void set(Index k, const V<T> &x) const { scatter(x, data + first * width + k, width, count); }
    void set(Index k, const Vec<T> &v) const { set(k, v.x), set(k + 1, v.y), set(k + 2, v.z); }
};

template <class T> V<T> each(const V<T> &x, T (*f)(T)) {
    V<T> out = {};
    for (Index k = 0; k < LANES<T>; ++k) out[k] = f(x[k]);
    return out;
}

// 2 / |quaternion|^2, and what this times makes of gravity, beyond gravity itself, in the base frame
template <class T> struct Attitude {
    Vec<T> u, g, h;
    V<T> w, s;
    Attitude(const Input<T> &q, const T *gravity)
        : u(q.vec(3)), g(constant(gravity[0], gravity[1], gravity[2])), w(q[6]) {
        const V<T> square = dot(u, u) + w * w;
        for (Index k = 0; k < LANES<T>; ++k) s[k] = T(2) / (square[k] == 0 ? T(1) : square[k]);
        h = u * dot(u, g) - g * dot(u, u) - cross(u, g) * w;
    }
    Vec<T> gravity() const { return g + h * s; }
    void grad(const Vec<T> &to, const Output<T> &q) const {
        const V<T> size = s * s * dot(to, h); // minus twice the gradient of |quaternion|^2
        const Vec<T> d = to * s;
        q.set(3, d * dot(u, g) + g * dot(d, u) - u * (T(2) * dot(d, g) + size) - cross(g, d) * w);
        q.set(6, -dot(d, cross(u, g)) - w * size);
    }
};

template <class T> State<T> base_of(const Robot<T> &robot, const Input<T> &q, const Input<T> &v, const Input<T> &a) {
    State<T> out = base_state<T>();
    if (!robot.base) {
        out.force = constant(-robot.gravity[0], -robot.gravity[1], -robot.gravity[2]);
    } else if (v.data) {
        out.omega = v.vec(3), out.alpha = a.vec(3);
        out.force = a.vec(0) + cross(out.omega, v.vec(0)) - Attitude<T>(q, robot.gravity).gravity();
    }
    return out;
}

template <class T> Joint<T> joint_motion(const Robot<T> &robot, const Link<T> &node, const Input<T> &q,
                                         const Input<T> &v, const Input<T> &a) {
    Joint<T> out{};
    V<T> position = fill(node.offset);
    if (node.moves) {
        position += q[robot.size_q - robot.n + node.dof] * node.ratio;
        if (v.data) {
            out.velocity = v[robot.base + node.dof] * node.ratio;
            out.acceleration = a[robot.base + node.dof] * node.ratio;
        }
    }
    if (node.slides) {
        out.cosine = fill<T>(1), out.slide = position;
    } else {
        out.cosine = each<T>(position, std::cos), out.sine = each<T>(position, std::sin);
    }
    return out;
}

// Gradients of `moved` and of the joint's position, velocity and acceleration
template <class T> void moved_grad(const State<T> &up, const State<T> &own, const Link<T> &node, const Joint<T> &joint,
                                   State<T> &g, State<T> &g_up, V<T> (&g_joint)[3]) {
    const Vec<T> step = own.position - up.position, z = own.axes.z;
    const Vec<T> turned = node.slides ? zero<T>() : z * joint.velocity;
    const Vec<T> slid = node.slides ? z * joint.velocity : zero<T>();
    g_up.force += g.force, g_up.alpha += g.alpha, g_up.omega += g.omega, g_up.position += g.position;
    g_up.alpha += cross(step, g.force);
    const Vec<T> inner = cross(g.force, up.omega);
    g_up.omega +=
        cross(cross(up.omega, step) + slid * fill<T>(2), g.force) + cross(step, inner) + cross(turned, g.alpha);
    g.position += cross(g.force, up.alpha) + cross(inner, up.omega); // from here on of the step
    const Vec<T> faster = node.slides ? g.force : g.alpha;
    const Vec<T> along = node.slides ? inner * fill<T>(2) : g.omega + cross(g.alpha, up.omega);
    g_joint[1] = dot(along, z), g_joint[2] = dot(faster, z);
    g.axes.z += along * joint.velocity + faster * joint.acceleration + g.position * joint.slide;
    g_joint[0] = node.slides ? dot(g.position, z) : dot(g.axes.x, own.axes.y) - dot(g.axes.y, own.axes.x);
    g_up.axes.out_grad(column(node.pose, 0), g.axes.x * joint.cosine - g.axes.y * joint.sine);
    g_up.axes.out_grad(column(node.pose, 1), g.axes.x * joint.sine + g.axes.y * joint.cosine);
    g_up.axes.out_grad(column(node.pose, 2), g.axes.z);
    g_up.axes.out_grad(column(node.pose, 3), g.position);
}

// A frame (3, 4) on a node: its axes and origin, and the node's motion there, in the frame's axes
template <class T> State<T> on_node(const State<T> &node, const T *pose, bool framed) {
    State<T> out = node;
    if (framed) {
        const Vec<T> arm = node.axes.out(column(pose, 3));
        out.axes = {node.axes.out(column(pose, 0)), node.axes.out(column(pose, 1)), node.axes.out(column(pose, 2))};
        out.position += arm;
        out.force += cross(node.alpha, arm) + cross(node.omega, cross(node.omega, arm));
    }
    out.omega = out.axes.in(out.omega), out.alpha = out.axes.in(out.alpha), out.force = out.axes.in(out.force);
    return out;
}

template <class T>
void on_node_grad(const State<T> &node, const State<T> &own, const T *pose, bool framed, State<T> &g, State<T> &to) {
    const Vec<T> omega = g.omega, alpha = g.alpha, force = g.force;
    const Vec<T> arm = framed ? node.axes.out(column(pose, 3)) : zero<T>();
    const Vec<T> swing = cross(node.omega, arm);
    g.axes.in_grad(node.omega, omega), g.axes.in_grad(node.alpha, alpha);
    g.axes.in_grad(node.force + cross(node.alpha, arm) + cross(node.omega, swing), force);
    const Vec<T> f = own.axes.out(force), inner = cross(f, node.omega);
    to.force += f, to.position += g.position;
    to.alpha += own.axes.out(alpha) + cross(arm, f);
    to.omega += own.axes.out(omega) + cross(swing, f) + cross(arm, inner);
    if (!framed) {
        to.axes.x += g.axes.x, to.axes.y += g.axes.y, to.axes.z += g.axes.z;
        return;
    }
    to.axes.out_grad(column(pose, 0), g.axes.x), to.axes.out_grad(column(pose, 1), g.axes.y);
    to.axes.out_grad(column(pose, 2), g.axes.z);
    to.axes.out_grad(column(pose, 3), g.position + cross(f, node.alpha) + cross(inner, node.omega));
}

// Screws of the base's force and moment along axis k, and of a joint, seen from a frame
template <class T> Vec<T> unit(int k) { return constant(T(k == 0), T(k == 1), T(k == 2)); }
template <class T> Screw<T> base_screw(const State<T> &frame, int row) {
    const Vec<T> e = unit<T>(row % 3), own = frame.axes.in(e);
    return row < 3 ? Screw<T>{own, zero<T>()} : Screw<T>{frame.axes.in(cross(e, frame.position)), own};
}
template <class T> void base_screw_grad(const State<T> &frame, int row, const Screw<T> &s, State<T> &g) {
    const Vec<T> e = unit<T>(row % 3);
    if (row < 3) return g.axes.in_grad(e, s.linear);
    g.axes.in_grad(cross(e, frame.position), s.linear), g.axes.in_grad(e, s.angular);
    g.position += cross(frame.axes.out(s.linear), e);
}
template <class T> Screw<T> joint_screw(const State<T> &frame, const State<T> &joint, const Link<T> &node) {
    const Vec<T> z = joint.axes.z * fill(node.ratio);
    if (node.slides) return {frame.axes.in(z), zero<T>()};
    return {frame.axes.in(cross(z, frame.position - joint.position)), frame.axes.in(z)};
}
template <class T> void joint_screw_grad(const State<T> &frame, const State<T> &joint, const Link<T> &node,
                                         const Screw<T> &s, State<T> &g, State<T> &g_joint) {
    const V<T> ratio = fill(node.ratio);
    const Vec<T> z = joint.axes.z * ratio, l = frame.axes.out(s.linear);
    if (node.slides) {
        g.axes.in_grad(z, s.linear), g_joint.axes.z += l * ratio;
        return;
    }
    const Vec<T> arm = frame.position - joint.position, pull = cross(l, z);
    g.axes.in_grad(cross(z, arm), s.linear), g.axes.in_grad(z, s.angular);
    g.position += pull, g_joint.position -= pull;
    g_joint.axes.z += (cross(arm, l) + frame.axes.out(s.angular)) * ratio;
}

// Numbers of a body's ten inertial parameters: m, m c, and Ixx, Ixy, Ixz, Iyy, Iyz, Izz
template <class T> struct Ten {
    V<T> m;
    Vec<T> c;
    V<T> xx, xy, xz, yy, yz, zz;
    Vec<T> inertia(const Vec<T> &v) const {
        return {xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z};
    }
};

// What a screw feels of the wrenches of a unit of each parameter, at a body's motion in its own axes
template <class T> Ten<T> felt(const Screw<T> &s, const State<T> &body) {
    const Vec<T> &w = body.omega, &a = body.alpha, &m = s.angular;
    const Vec<T> u = cross(m, w);
    const Vec<T> c = cross(s.linear, a) + w * dot(s.linear, w) - s.linear * dot(w, w) + cross(body.force, m);
    return {dot(s.linear, body.force),
            c,
            m.x * a.x + u.x * w.x,
            m.x * a.y + m.y * a.x + u.x * w.y + u.y * w.x,
            m.x * a.z + m.z * a.x + u.x * w.z + u.z * w.x,
            m.y * a.y + u.y * w.y,
            m.y * a.z + m.z * a.y + u.y * w.z + u.z * w.y,
            m.z * a.z + u.z * w.z};
}
// The wrench that a body needs, in its axes about its origin (Newton and Euler)
template <class T> Screw<T> wrench(const Ten<T> &p, const State<T> &body) {
    const Vec<T> &w = body.omega;
    return {body.force * p.m + cross(body.alpha, p.c) + w * dot(w, p.c) - p.c * dot(w, w),
            cross(p.c, body.force) + p.inertia(body.alpha) + cross(w, p.inertia(w))};
}
// Gradient of what a screw feels of a body with some parameters, by the body's motion
template <class T> void felt_grad(const Screw<T> &s, const Ten<T> &p, const State<T> &body, State<T> &g) {
    const Vec<T> &w = body.omega;
    g.force += s.linear * p.m + cross(s.angular, p.c);
    g.alpha += cross(p.c, s.linear) + p.inertia(s.angular);
    g.omega += s.linear * dot(w, p.c) + p.c * dot(s.linear, w) - w * (T(2) * dot(s.linear, p.c)) +
               p.inertia(cross(s.angular, w)) + cross(p.inertia(w), s.angular);
}

template <class T> struct Batch { // lanes of samples, and what is known of them
    Input<T> q, v, a;
    std::vector<State<T>> joints, g_joints;
    std::vector<Joint<T>> motion;
};

template <class T> struct Call { // arguments of a call; strides in numbers
    const T *q, *v, *a, *phi;
    Index samples, phi_step;
    const T *grad;
    Index grad_sample, grad_row, grad_column;
    T *out, *g_q, *g_v, *g_a, *g_phi;
};

template <class T> void set_states(const Robot<T> &robot, const Call<T> &call, Index first, Batch<T> &batch) {
    const Index count = std::min(LANES<T>, call.samples - first);
    batch.q = {call.q, robot.size_q, first, count};
    batch.v = {call.v, robot.size_v, first, count}, batch.a = {call.a, robot.size_v, first, count};
    batch.joints.resize(robot.nodes.size()), batch.motion.resize(robot.nodes.size());
    batch.joints[0] = base_of(robot, batch.q, batch.v, batch.a);
    for (size_t i = 1; i < robot.nodes.size(); ++i) {
        batch.motion[i] = joint_motion(robot, robot.nodes[i], batch.q, batch.v, batch.a);
        batch.joints[i] =
            moved(batch.joints[robot.nodes[i].parent], robot.nodes[i].pose, robot.nodes[i].slides, batch.motion[i]);
    }
}

// Screw of a row, of one term or more, and its gradient
template <class T>
Screw<T> row_screw(const Robot<T> &robot, const Term *term, const State<T> &frame, const Batch<T> &batch) {
    if (term->joint < 0) return base_screw(frame, int(term->row));
    Screw<T> s = joint_screw(frame, batch.joints[term->joint], robot.nodes[term->joint]);
    for (; term->more; ++term) {
        const Screw<T> more = joint_screw(frame, batch.joints[term[1].joint], robot.nodes[term[1].joint]);
        s = s + more;
    }
    return s;
}
template <class T> void row_screw_grad(const Robot<T> &robot, const Term *term, const State<T> &frame,
                                       const Screw<T> &s, State<T> &g, Batch<T> &batch) {
    if (term->joint < 0) return base_screw_grad(frame, int(term->row), s, g);
    for (;; ++term) {
        const Index joint = term->joint;
        joint_screw_grad(frame, batch.joints[joint], robot.nodes[joint], s, g, batch.g_joints[joint]);
        if (!term->more) return;
    }
}

template <class T> V<T> direction(const Robot<T> &robot, const V<T> &velocity) { // factor of Coulomb friction
    V<T> out = {};
    for (Index k = 0; k < LANES<T>; ++k)
        out[k] = robot.width > 0 ? std::tanh(velocity[k] / robot.width) : T((velocity[k] > 0) - (velocity[k] < 0));
    return out;
}

template <class T> Ten<T> ten(const Link<T> &node, const T *data, Index step, Index lane, Index count) {
    V<T> x[10];
    for (int k = 0; k < 10; ++k)
        x[k] = node.columns[k] < 0 ? V<T>{} : gather(data + node.columns[k] * step, lane, count);
    return {x[0], {x[1], x[2], x[3]}, x[4], x[5], x[6], x[7], x[8], x[9]};
}
template <class T, class Put> void each_of(const Ten<T> &x, bool force_only, Put &&put) {
    put(0, x.m), put(1, x.c.x), put(2, x.c.y), put(3, x.c.z);
    if (force_only) return;
    put(4, x.xx), put(5, x.xy), put(6, x.xz), put(7, x.yy), put(8, x.yz), put(9, x.zz);
}

// K, (rows, columns, samples), of which zeros are not written; with parameters K phi, (samples, rows)
template <class T> void dynamics(const Robot<T> &robot, const Call<T> &call, Index begin, Index end) {
    std::vector<Batch<T>> batches(GROUPS);
    State<T> frames[GROUPS];
    Screw<T> needs[GROUPS];
    std::vector<V<T>> torques(call.phi ? GROUPS * robot.rows : 0);
    for (Index start = begin; start < end; start += GROUPS * LANES<T>) {
        const Index used = std::min(GROUPS, (end - start + LANES<T> - 1) / LANES<T>);
        for (Index g = 0; g < used; ++g) set_states(robot, call, start + g * LANES<T>, batches[g]);
        std::fill(torques.begin(), torques.end(), V<T>{});
        for (size_t i = 0; i < robot.nodes.size(); ++i) {
            const Link<T> &node = robot.nodes[i];
            if (!node.terms) continue;
            const auto out = [&](Index row, Index column, Index g, const V<T> &x) {
                if (column < 0) return;
                T *to = call.out + (row * robot.columns + column) * call.samples + start + g * LANES<T>;
                store(to, x, batches[g].q.count);
            };
            const auto phi_of = [&](Index g) { return call.phi + call.phi_step * (start + g * LANES<T>); };
            for (Index g = 0; g < used; ++g) {
                frames[g] = on_node(batches[g].joints[i], node.link, node.framed);
                if (call.phi) needs[g] = wrench(ten(node, phi_of(g), 1, call.phi_step, batches[g].q.count), frames[g]);
            }
            for (const Term *term = robot.terms + node.first_term, *last = term + node.terms; term < last; ++term) {
                for (Index g = 0; g < used; ++g) {
                    const Screw<T> s = row_screw(robot, term, frames[g], batches[g]);
                    if (call.phi) {
                        torques[g * robot.rows + term->row] +=
                            dot(s.linear, needs[g].linear) + dot(s.angular, needs[g].angular);
                    } else {
                        each_of(felt(s, frames[g]), term->row < std::min<Index>(3, robot.base),
                                [&](int k, const V<T> &x) { out(term->row, node.columns[k], g, x); });
                    }
                }
                while (term->more) ++term;
            }
            if (!node.moves) continue;
            const Index row = robot.base + node.dof;
            for (Index g = 0; g < used; ++g) {
                const V<T> velocity = batches[g].motion[i].velocity, ratio = fill(node.ratio);
                const V<T> coulomb = direction(robot, velocity) * ratio, viscous = velocity * ratio;
                if (!call.phi) {
                    out(row, node.columns[10], g, coulomb), out(row, node.columns[11], g, viscous);
                    continue;
                }
                const auto phi = [&](int k) {
                    return gather(phi_of(g) + node.columns[k], call.phi_step, batches[g].q.count);
                };
                torques[g * robot.rows + row] += coulomb * phi(10) + viscous * phi(11);
            }
        }
        for (Index g = 0; g < used && call.phi; ++g)
            for (Index row = 0; row < robot.rows; ++row)
                scatter(torques[g * robot.rows + row], call.out + batches[g].q.first * robot.rows + row, robot.rows,
                        batches[g].q.count);
    }
}

// Gradients of q, v and a, (samples, width) each, from those of all states; `of_joints` has more of them
template <class T>
void states_grad(const Robot<T> &robot, const Call<T> &call, Batch<T> &batch, std::vector<V<T>> &of_joints) {
    const auto to = [&](T *data, Index width) { return Output<T>{data, width, batch.q.first, batch.q.count}; };
    const Output<T> g_q = to(call.g_q, robot.size_q), g_v = to(call.g_v, robot.size_v),
                    g_a = to(call.g_a, robot.size_v);
    for (size_t i = robot.nodes.size(); --i > 0;) {
        const Link<T> &node = robot.nodes[i];
        V<T> g_joint[3];
        moved_grad(batch.joints[node.parent], batch.joints[i], node, batch.motion[i], batch.g_joints[i],
                   batch.g_joints[node.parent], g_joint);
        for (int k = 0; k < 3 && node.moves; ++k) of_joints[3 * node.dof + k] += g_joint[k] * node.ratio;
    }
    for (Index dof = 0; dof < robot.n; ++dof) {
        g_q.set(robot.size_q - robot.n + dof, of_joints[3 * dof]);
        if (!call.v) continue;
        g_v.set(robot.base + dof, of_joints[3 * dof + 1]), g_a.set(robot.base + dof, of_joints[3 * dof + 2]);
    }
    if (!robot.base || !call.v) return;
    const State<T> &g = batch.g_joints[0];
    g_v.set(0, cross(g.force, batch.joints[0].omega)), g_a.set(0, g.force);
    g_v.set(3, g.omega + cross(batch.v.vec(0), g.force)), g_a.set(3, g.alpha);
    Attitude<T>(batch.q, robot.gravity).grad(zero<T>() - g.force, g_q);
}

// Gradients of what `dynamics` writes, by q, v, a (unless null) and, with parameters, by these: (samples, columns)
template <class T> void dynamics_grad(const Robot<T> &robot, const Call<T> &call, Index begin, Index end) {
    Batch<T> batch;
    for (Index start = begin; start < end; start += LANES<T>) {
        set_states(robot, call, start, batch);
        batch.g_joints.assign(robot.nodes.size(), State<T>{});
        const bool of_state = call.g_q; // and not of the parameters alone
        const Index count = batch.q.count;
        const T *grads = call.grad + start * call.grad_sample, *phi = call.phi + start * call.phi_step;
        const Output<T> g_phi{call.g_phi, robot.columns, start, count};
        std::vector<V<T>> of_joints(3 * robot.n);
        for (size_t i = 0; i < robot.nodes.size(); ++i) {
            const Link<T> &node = robot.nodes[i];
            if (!node.terms) continue;
            const State<T> frame = on_node(batch.joints[i], node.link, node.framed);
            State<T> g{};
            Screw<T> total{}, need{};
            Ten<T> p{};
            if (call.phi) p = ten(node, phi, 1, call.phi_step, count), need = wrench(p, frame);
            for (const Term *term = robot.terms + node.first_term, *last = term + node.terms; term < last; ++term) {
                const Screw<T> s = row_screw(robot, term, frame, batch);
                const T *row = grads + term->row * call.grad_row;
                if (call.phi) {
                    const V<T> torque = gather(row, call.grad_sample, count);
                    total = total + s * torque;
                    if (of_state) row_screw_grad(robot, term, frame, need * torque, g, batch);
                } else {
                    const Ten<T> weights = ten(node, row, call.grad_column, call.grad_sample, count);
                    felt_grad(s, weights, frame, g);
                    row_screw_grad(robot, term, frame, wrench(weights, frame), g, batch);
                }
                while (term->more) ++term;
            }
            if (call.phi) {
                if (of_state) felt_grad(total, p, frame, g);
                each_of(felt(total, frame), false, [&](int k, const V<T> &x) {
                    if (node.columns[k] >= 0) g_phi.set(node.columns[k], x);
                });
            }
            if (of_state) on_node_grad(batch.joints[i], frame, node.link, node.framed, g, batch.g_joints[i]);
            if (!node.moves) continue;
            const V<T> velocity = batch.motion[i].velocity, along = direction(robot, velocity);
            const V<T> slope = robot.width > 0 ? (T(1) - along * along) / robot.width : V<T>{};
            const T *row = grads + (robot.base + node.dof) * call.grad_row;
            V<T> coulomb, viscous, torque = fill(node.ratio);
            if (call.phi) {
                torque *= gather(row, call.grad_sample, count);
                coulomb = gather(phi + node.columns[10], call.phi_step, count);
                viscous = gather(phi + node.columns[11], call.phi_step, count);
                g_phi.set(node.columns[10], torque * along), g_phi.set(node.columns[11], torque * velocity);
            } else {
                coulomb = gather(row + node.columns[10] * call.grad_column, call.grad_sample, count);
                viscous = gather(row + node.columns[11] * call.grad_column, call.grad_sample, count);
            }
            of_joints[3 * node.dof + 1] += torque * (coulomb * slope + viscous) * node.ratio;
        }
        if (of_state) states_grad(robot, call, batch, of_joints);
    }
}

// Jacobian of the last node, a frame that is fixed to its parent: (6, rows, samples)
template <class T> void frame(const Robot<T> &robot, const Call<T> &call, Index begin, Index end) {
    Batch<T> batch;
    const Link<T> &node = robot.nodes.back();
    for (Index start = begin; start < end; start += LANES<T>) {
        set_states(robot, call, start, batch);
        for (const Term *term = robot.terms + node.first_term, *last = term + node.terms; term < last; ++term) {
            const Screw<T> s = row_screw(robot, term, batch.joints.back(), batch);
            const V<T> x[6] = {s.linear.x, s.linear.y, s.linear.z, s.angular.x, s.angular.y, s.angular.z};
            for (int k = 0; k < 6; ++k)
                store(call.out + (k * robot.rows + term->row) * call.samples + start, x[k], batch.q.count);
            while (term->more) ++term;
        }
    }
}

template <class T> void frame_grad(const Robot<T> &robot, const Call<T> &call, Index begin, Index end) {
    Batch<T> batch;
    const Link<T> &node = robot.nodes.back();
    for (Index start = begin; start < end; start += LANES<T>) {
        set_states(robot, call, start, batch);
        batch.g_joints.assign(robot.nodes.size(), State<T>{});
        for (const Term *term = robot.terms + node.first_term, *last = term + node.terms; term < last; ++term) {
            V<T> x[6];
            for (int k = 0; k < 6; ++k)
                x[k] = gather(call.grad + start * call.grad_sample + k * call.grad_row + term->row * call.grad_column,
                              call.grad_sample, batch.q.count);
            const Screw<T> s{{x[0], x[1], x[2]}, {x[3], x[4], x[5]}};
            row_screw_grad(robot, term, batch.joints.back(), s, batch.g_joints.back(), batch);
            while (term->more) ++term;
        }
        std::vector<V<T>> of_joints(3 * robot.n);
        states_grad(robot, call, batch, of_joints);
    }
}

} // namespace

template <class T> void run(const Index *table, const T *reals, const Call<T> &call, Index threads, bool of_frame) {
    const Robot<T> robot(table, reals);
    const auto work = of_frame ? (call.grad ? frame_grad<T> : frame<T>) : (call.grad ? dynamics_grad<T> : dynamics<T>);
    in_threads(call.samples, GROUPS * LANES<T>, threads, [&](Index a, Index b) { work(robot, call, a, b); });
}

extern "C" {
void torchid_dynamics_float64(const Index *table, const double *reals, const Call<double> *call, Index threads) {
    run(table, reals, *call, threads, false);
}
void torchid_dynamics_float32(const Index *table, const float *reals, const Call<float> *call, Index threads) {
    run(table, reals, *call, threads, false);
}
void torchid_frame_float64(const Index *table, const double *reals, const Call<double> *call, Index threads) {
    run(table, reals, *call, threads, true);
}
void torchid_frame_float32(const Index *table, const float *reals, const Call<float> *call, Index threads) {
    run(table, reals, *call, threads, true);
}
}
