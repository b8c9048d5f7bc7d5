// Whitened null-space bases of robots that stand on limbs of their own: what `torchid.sensing.limbs` computes.
#include "spatial.h"

namespace {

constexpr Int BASE = 6; // rows of the base in a generalized force, and columns of W

// Contacts of a state, as `torchid.problem.compiled_rows` passes them.
struct Limbs {
    Int count, dofs;        // limbs, and m rows of W
    const Int *limbs;       // (limbs, 5): node in contact, joints k, first in `wrenches` and `joints`, first and end in `moved`
    const double *wrenches; // (k of each limb, 6): unmeasured ones, in axes of the node
    const Int *joints;      // (k of each limb,): joint's row in W, without the base's
    const Int *moved;       // (nodes that move the contacts, 2): joint's number in its limb, node
    const double *ratios;   // of the nodes' motion to the joint's
    const double *row_std;  // (m,), noise of the base and of the joints [N, N m]
};

// Write a limb's contact rows (k, 6 + k): unit wrenches at the base origin, then their power along each joint.
void write_limb(const Limbs &limbs, const Int *limb, const Node *states, Lanes *rows) {
    const Node &foot = states[limb[0]];
    const Int k = limb[1], width = BASE + k;
    for (Int number = 0; number < k; ++number) {
        const double *unit = limbs.wrenches + 6 * (limb[2] + number);
        Screw<double> wrench = {foot.axes.out(constant(unit[0], unit[1], unit[2])), foot.axes.out(constant(unit[3], unit[4], unit[5]))};
        wrench.angular = wrench.angular + cross(foot.position, wrench.linear);
        Lanes *row = rows + number * width;
        std::memcpy(row, &wrench, sizeof wrench);
        for (Int joint = 0; joint < k; ++joint) row[BASE + joint] = Lanes{};
        for (Int move = limb[3]; move < limb[4]; ++move)
            row[BASE + limbs.moved[2 * move]] += limbs.ratios[move] * dot(states[limbs.moved[2 * move + 1]].screw, wrench);
    }
}

// Reflect `count` rows (Householder) so that column `last` is zero below the first; apply it to all columns before.
void reflect(Lanes *rows, Int width, Int count, Int last) {
    Lanes square = {};
    for (Int row = 0; row < count; ++row) square += rows[row * width + last] * rows[row * width + last];
    const Lanes root = square_root<double>(square), first = rows[last];
    const Lanes length = first < 0.0 ? -root : root;
    rows[last] = first + length;
    const Lanes inverse = 1.0 / (length * rows[last]);
    for (Int column = 0; column < last; ++column) {
        Lanes along = {};
        for (Int row = 0; row < count; ++row) along += rows[row * width + last] * rows[row * width + column];
        along *= inverse;
        for (Int row = 0; row < count; ++row) rows[row * width + column] -= along * rows[row * width + last];
    }
    rows[last] = -length;
}

// Write -L^-1 B of a limb's rows [B L] to its joints' rows of W, and its squared condition number if that is larger.
void solve(const Limbs &limbs, const Int *limb, Lanes *rows, Lanes *W, Lanes &condition) {
    const Int k = limb[1], width = BASE + k;
    Lanes size = {}, size_of_inverse = {};
    for (Int row = 0; row < k; ++row)
        for (Int column = BASE; column < width; ++column) size += rows[row * width + column] * rows[row * width + column];
    for (Int done = 0; done < k - 1; ++done) reflect(rows + done * width, width, k - done, width - 1 - done);
    for (Int row = k - 1; row >= 0; --row) { // L is triangular now: its last rows begin with the diagonal
        const Int diagonal = width - 1 - row;
        const Lanes inverse = 1.0 / rows[row * width + diagonal];
        Lanes *out = W + (BASE + limbs.joints[limb[2] + k - 1 - row]) * BASE;
        for (Int column = 0; column < BASE; ++column) {
            const Lanes x = inverse * rows[row * width + column];
            for (Int other = 0; other < row; ++other) rows[other * width + column] -= rows[other * width + diagonal] * x;
            out[column] = -x;
            size_of_inverse += x * x;
        }
    }
    const Lanes square = size_of_inverse * size;
    condition = square <= condition ? condition : square; // NaN stays
}

// Orthonormalize the columns of W (m, 6) by the modified Gram-Schmidt process; returns where a pivot is too small.
auto orthonormalize(Lanes *W, Int m, double least_pivot) {
    Lanes before[BASE] = {};
    for (Int k = 0; k < BASE * m; ++k) before[k % BASE] += W[k] * W[k];
    auto suspect = before[0] != before[0];
    for (Int column = 0; column < BASE; ++column) {
        Lanes square = {};
        for (Int row = 0; row < m; ++row) square += W[row * BASE + column] * W[row * BASE + column];
        suspect |= ~(square > least_pivot * before[column]);
        const Lanes inverse = 1.0 / square_root<double>(square);
        Lanes along[BASE] = {};
        for (Int row = 0; row < m; ++row) {
            W[row * BASE + column] *= inverse;
            for (Int other = column + 1; other < BASE; ++other) along[other] += W[row * BASE + column] * W[row * BASE + other];
        }
        for (Int row = 0; row < m; ++row)
            for (Int other = column + 1; other < BASE; ++other) W[row * BASE + other] -= along[other] * W[row * BASE + column];
    }
    return suspect;
}

void scale_rows(Lanes *W, Int first, Int end, const double *row_std, bool divide) {
    for (Int row = first; row < end; ++row)
        for (Int column = 0; column < BASE; ++column) W[row * BASE + column] *= divide ? 1.0 / row_std[row] : row_std[row];
}

} // namespace

// Write W of each sample, as `limb_null_space` gives it where contact forces are unmeasured.
//
// axes: (T, 9, TILE), by rows the matrix whose columns are the axes of the base rows' noise, in base axes.
// worst: squared condition number of a limb from which on a sample is suspect.
// least_pivot: fraction of a column's square that must remain.
// W: tiles (m, 6, TILE), written.
// suspect: (T TILE,), written: W of such samples is worthless.
extern "C" void write_bases(const Motion *motion, const Limbs *limbs, const double *axes, double worst, double least_pivot,
                            double *W, bool *suspect) {
    const Int m = limbs->dofs;
    std::vector<Node> states(motion->nodes);
    std::vector<Lanes> rows(BASE * 2 * BASE), basis(m * BASE);
    for (Int tile = 0; tile < motion->tiles; ++tile) {
        write_states(*motion, tile, states.data());
        basis.assign(m * BASE, Lanes{});
        Lanes condition = {};
        for (Int limb = 0; limb < limbs->count; ++limb) {
            const Int *entry = limbs->limbs + 5 * limb;
            write_limb(*limbs, entry, states.data(), rows.data());
            solve(*limbs, entry, rows.data(), basis.data(), condition);
        }
        scale_rows(basis.data(), BASE, m, limbs->row_std, false);
        Lanes noise[3][3]; // by rows
        for (Int k = 0; k < 9; ++k) noise[k / 3][k % 3] = load(axes + (tile * 9 + k) * TILE);
        for (Int row = 0; row < BASE; ++row)
            for (Int k = 0; k < 3; ++k) basis[row * BASE + row - row % 3 + k] = limbs->row_std[row] * noise[k][row % 3];
        auto doubtful = orthonormalize(basis.data(), m, least_pivot) | ~(condition < worst);
        for (Int t = 0; t < TILE; ++t) suspect[tile * TILE + t] = doubtful[t];
        scale_rows(basis.data(), 0, m, limbs->row_std, true);
        for (Int first = 0; first < BASE; first += 3) // back to the base's axes
            for (Int column = 0; column < BASE; ++column) {
                Lanes *x = &basis[first * BASE + column];
                const Lanes a = x[0], b = x[BASE], c = x[2 * BASE];
                for (Int k = 0; k < 3; ++k) x[k * BASE] = noise[k][0] * a + noise[k][1] * b + noise[k][2] * c;
            }
        std::memcpy(W + tile * m * BASE * TILE, basis.data(), m * BASE * sizeof(Lanes));
    }
}
