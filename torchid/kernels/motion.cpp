// Motion of all joints from the independent ones: what `torchid.regressor.kinematics.joint_motion` gives, tile by tile.
#include "spatial.h"

namespace {

// How nodes follow the independent joints: node k is moved by `joint` and `ratio` from first[k] to first[k + 1].
struct Mechanism {
    Int nodes, joints;                     // L, n
    const Int *first, *joint;              // (L + 1,), (terms,)
    const double *ratio, *constant;        // (terms,), (L,): position where all independent joints are at 0 [rad or m]
    const double *revolute, *prismatic;    // (L,) of 0 and 1
};

// Samples (B, n) and (B, 3), as a log has them; `direction` is null for the sign of velocities.
struct Log {
    Int samples;
    const double *position, *velocity, *acceleration, *direction, *base[3];
};

// Sine and cosine of angles [rad], to 1e-16: reduced to at most pi / 4, then the polynomials of fdlibm.
void write_sine_cosine(const Lanes &x, Lanes &sine, Lanes &cosine) {
    constexpr double LARGEST = 1e5, ROUND = 0x1.8p52; // adding the latter leaves an integer in a number's last bits
    bool small = true;
    for (Int t = 0; t < TILE; ++t) small = small && std::fabs(x[t]) < LARGEST;
    if (!small) {
        for (Int t = 0; t < TILE; ++t) sine[t] = std::sin(x[t]), cosine[t] = std::cos(x[t]);
        return;
    }
    const Lanes rounded = x * (2.0 / M_PI) + ROUND, n = rounded - ROUND;
    // pi / 2 in three parts, so short that their products with n are exact
    const Lanes r = ((x - n * 1.57079632673412561417e+00) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21;
    const Lanes z = r * r;
    const Lanes s = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 +
                    z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 +
                    z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
    const Lanes c = 1.0 - 0.5 * z + z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 +
                    z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 +
                    z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))));
    decltype(x < x) quadrant;
    std::memcpy(&quadrant, &rounded, sizeof quadrant);
    const auto odd = (quadrant & 1) == 1;
    sine = odd ? c : s;
    cosine = odd ? s : c;
    sine = (quadrant & 2) == 2 ? -sine : sine;
    cosine = ((quadrant + 1) & 2) == 2 ? -cosine : cosine;
}

} // namespace

// width: of Coulomb friction's tanh [rad/s or m/s]; 0 for the sign.
// joints, base: written as `Motion` has them.
extern "C" void write_motion(const Mechanism *mechanism, const Log *log, double width, double *joints, double *base) {
    const Int n = mechanism->joints;
    for (Int begin = 0; begin < log->samples; begin += TILE) {
        const Int count = log->samples - begin;
        for (Int k = 0; k < 9; ++k, base += TILE) store(base, gather(log->base[k / 3] + 3 * begin + k % 3, 3, count));
        for (Int node = 0; node < mechanism->nodes; ++node, joints += JOINT_ROWS * TILE) {
            Lanes position = fill(mechanism->constant[node]), velocity = {}, acceleration = {}, direction = {};
            for (Int term = mechanism->first[node]; term < mechanism->first[node + 1]; ++term) {
                const Int at = begin * n + mechanism->joint[term];
                const double ratio = mechanism->ratio[term];
                position += ratio * gather(log->position + at, n, count);
                velocity += ratio * gather(log->velocity + at, n, count);
                acceleration += ratio * gather(log->acceleration + at, n, count);
                if (log->direction) direction += std::copysign(1.0, ratio) * gather(log->direction + at, n, count);
            }
            if (!log->direction && width > 0.0)
                for (Int t = 0; t < TILE; ++t) direction[t] = std::tanh(velocity[t] / width);
            else if (!log->direction)
                direction = velocity > 0.0 ? fill(1.0) : velocity < 0.0 ? fill(-1.0) : Lanes{};
            Lanes sine = {}, cosine = fill(1.0);
            if (mechanism->revolute[node] != 0.0) write_sine_cosine(position, sine, cosine);
            store(joints + COSINE * TILE, cosine);
            store(joints + SINE * TILE, sine);
            store(joints + SLIDE * TILE, mechanism->prismatic[node] * position);
            store(joints + VELOCITY * TILE, velocity);
            store(joints + ACCELERATION * TILE, acceleration);
            store(joints + DIRECTION * TILE, direction);
        }
    }
}
