// Blocks of rows in the inertial and friction parameters, tile by tile, and their Gram matrices.
#include "gram.h"
#include <algorithm>

namespace {

// As in torchid.problem.compiled_rows: samples whose rows are multiplied at once, and numbers between their columns.
constexpr Int SPAN = 128, PADDING = 8;
constexpr Int INERTIA = 4; // the first inertial parameter that demands no force

// A block of rows: its first row in W and their number, columns with the right-hand side, where it starts in memory,
// the path sum of the base (0 without), and the degrees of freedom of its right-hand side.
struct Block {
    Int first, count, width, start, path_sum, dof, end;
};
// A node that a block moves: its degree of freedom in W, its path sum and that of the node above (0 for none), and its
// first friction column.
struct Move {
    Int block, node, dof, path_sum, above, column;
};
// A body that a block depends on: its path sum, its first column, and which of `kept` are its parameters.
struct Body {
    Int node, block, path_sum, column, first, count;
};

// Rows at the samples of a chunk, as `torchid.problem.compiled_rows` passes them.
struct Rows {
    Int samples, rank, step; // B; rows of all blocks at a sample; numbers between tiles of W, 0 if one serves for all
    const double *W;         // tiles (degrees of freedom, rank, TILE)
    const double *forces;    // (degrees of freedom, B), measured [N, N m]
    Int block_count, move_count, body_count, path_sums;
    const Block *blocks;
    const Move *moves;
    const double *ratios; // of the nodes' motion to their joint's
    const Body *bodies;   // ascending by node; those with most parameters of a node first
    const Int *kept;      // numbers of inertial parameters
};

// Where rows are written: `room` samples of each block. `step`: from column to column of a block, less its width if
// there is space above the rows.
struct Target {
    double *data;
    Int room;
    bool packed; // without space above the rows, columns aligned

    Int step(const Block &block) const {
        return packed ? block.count * SPAN + PADDING : block.width + block.count * room;
    }
    double *at(const Block &block, Int column, Int row) const {
        return data + block.start + column * step(block) + (packed ? 0 : block.width) + row * room;
    }
};

// Writes the rows of one tile after the other.
class Writer {
  public:
    Writer(const Motion &motion, const Rows &rows) : motion(motion), rows(rows), states(motion.nodes) {
        for (Int b = 0; b < rows.block_count; ++b) most = std::max(most, rows.blocks[b].count);
        sums.resize(rows.path_sums * most); // the first is zero
    }

    // Samples from `begin` to `end`, the first a multiple of TILE.
    void write(Int begin, Int end, const Target &target) {
        for (to = 0; to < end - begin; to += TILE) {
            tile = (begin + to) / TILE, size = end - begin - to;
            write_states(motion, tile, states.data());
            size < TILE ? write_tile<false>(target) : write_tile<true>(target);
        }
    }

  private:
    const Motion &motion;
    const Rows &rows;
    std::vector<Node> states;
    std::vector<Screw<double>> sums; // (path sums, most): of each row's W times the screw axes from the base to a node
    Screw<double> wrenches[10];      // at the base origin, of a unit of each parameter of a body
    Int most = 0, tile = 0, to = 0, size = 0;

    template <bool whole> void write_tile(const Target &target) {
        for (Int b = 0; b < rows.block_count; ++b) start_block<whole>(rows.blocks[b], target);
        for (Int number = 0; number < rows.move_count; ++number) write_move<whole>(number, target);
        for (Int number = 0; number < rows.body_count; ++number) write_body<whole>(number, target);
    }

    template <bool whole> void put(double *out, const Lanes &x) const { whole ? store(out, x) : store(out, x, size); }

    Lanes W(Int dof, Int row) const { return load(rows.W + tile * rows.step + (dof * rows.rank + row) * TILE); }

    // The path sum of the base, and the right-hand side.
    template <bool whole> void start_block(const Block &block, const Target &target) {
        for (Int row = 0; row < block.count; ++row) {
            const Int k = block.first + row;
            if (block.path_sum) sums[block.path_sum * most + row] = {{W(0, k), W(1, k), W(2, k)}, {W(3, k), W(4, k), W(5, k)}};
            Lanes total = {};
            for (Int dof = block.dof; dof < block.end; ++dof)
                total += W(dof, k) * load(rows.forces + dof * rows.samples + tile * TILE, size);
            put<whole>(target.at(block, block.width - 1, row) + to, total);
        }
    }

    // The path sums of a node that a block moves, and its columns of friction.
    template <bool whole> void write_move(Int number, const Target &target) {
        const Move &move = rows.moves[number];
        const Block &block = rows.blocks[move.block];
        const Lanes velocity = motion.joint(VELOCITY, move.node, tile);
        const Lanes direction = motion.joint(DIRECTION, move.node, tile);
        for (Int row = 0; row < block.count; ++row) {
            const Lanes w = rows.ratios[number] * W(move.dof, block.first + row);
            sums[move.path_sum * most + row] = sums[move.above * most + row] + states[move.node].screw * w;
            put<whole>(target.at(block, move.column, row) + to, w * direction);
            put<whole>(target.at(block, move.column + 1, row) + to, w * velocity);
        }
    }

    // The columns of a body's inertial parameters: its wrenches times the path sum of each row.
    template <bool whole> void write_body(Int number, const Target &target) {
        const Body &body = rows.bodies[number];
        const Block &block = rows.blocks[body.block];
        const Int *parameters = rows.kept + body.first;
        if (!number || body.node != rows.bodies[number - 1].node) write_wrenches(states[body.node], parameters, body.count);
        const Int step = target.step(block);
        for (Int row = 0; row < block.count; ++row) {
            const Vec<double> linear = sums[body.path_sum * most + row].linear, angular = sums[body.path_sum * most + row].angular;
            double *out = target.at(block, body.column, row) + to;
            for (Int k = 0; k < body.count; ++k, out += step) {
                Lanes power = dot(wrenches[k].angular, angular);
                if (parameters[k] < INERTIA) power += dot(wrenches[k].linear, linear);
                put<whole>(out, power);
            }
        }
    }

    // As `torchid.regressor.columns`: m a + alpha x h + omega x (omega x h), h x a + I alpha + omega x (I omega).
    void write_wrenches(const Node &state, const Int *parameters, Int count) {
        const Vec<double> a = state.axes.in(state.alpha), f = state.axes.in(state.force);
        const Vec<double> w = state.axes.in(state.omega);
        const Lanes xx = w.x * w.x, yy = w.y * w.y, zz = w.z * w.z, xy = w.x * w.y, xz = w.x * w.z, yz = w.y * w.z;
        const Lanes zero = {};
        const Vec<double> forces[INERTIA] = {f,
                                        {-yy - zz, a.z + xy, xz - a.y},
                                        {xy - a.z, -zz - xx, a.x + yz},
                                        {a.y + xz, yz - a.x, -xx - yy}};
        const Vec<double> moments[10] = {{},
                                    {zero, -f.z, f.y},
                                    {f.z, zero, -f.x},
                                    {-f.y, f.x, zero},
                                    {a.x, xz, -xy},
                                    {a.y - xz, a.x + yz, xx - yy},
                                    {a.z + xy, zz - xx, a.x - yz},
                                    {-yz, a.y, xy},
                                    {yy - zz, a.z - xy, a.y + xz},
                                    {yz, -xz, a.z}};
        for (Int k = 0; k < count; ++k) {
            Screw<double> &wrench = wrenches[k];
            wrench.angular = state.axes.out(moments[parameters[k]]);
            if (parameters[k] < INERTIA) {
                wrench.linear = state.axes.out(forces[parameters[k]]);
                wrench.angular = wrench.angular + cross(state.position, wrench.linear);
            }
        }
    }
};

} // namespace

// Write each block (width, width + count B) as in `torchid.problem.rows.BlockRows`, one after the other.
extern "C" void write_rows(const Motion *motion, const Rows *rows, double *out) {
    Writer(*motion, *rows).write(0, rows->samples, {out, rows->samples, false});
}

// Write what `write_gram` makes of the rows of each block; the rows never leave the caches.
//
// k: (blocks,), columns of each block that are replaced.
// lower, combination: of the blocks, one after the other, see `Levels`.
// scratch: rows of a span, (width, count SPAN + PADDING) of each block.
// squares, grams: likewise, written.
extern "C" void write_grams(const Motion *motion, const Rows *rows, const Int *k, const Int *lower,
                            const double *combination, double *scratch, double *squares, double *grams) {
    Writer writer(*motion, *rows);
    std::vector<Lanes> memory(*std::max_element(k, k + rows->block_count) * PANEL / TILE);
    for (Int begin = 0; begin < rows->samples; begin += SPAN) {
        const Int end = std::min(begin + SPAN, rows->samples), room = (end - begin + TILE - 1) / TILE * TILE;
        const Block *last = rows->blocks + rows->block_count - 1;
        const Target target = {scratch, room, true};
        if (room > end - begin) std::fill(scratch, target.at(*last, last->width, 0), 0.0); // after the last sample
        writer.write(begin, end, target);
        Levels levels = {0, lower, combination};
        double *square = squares, *gram = grams;
        for (const Block *block = rows->blocks; block <= last; ++block) {
            const Int n = block->width;
            levels.k = k[block - rows->blocks];
            if (begin == 0) std::fill(square, square + levels.k, 0.0), std::fill(gram, gram + n * n, 0.0);
            add_gram({scratch + block->start, n, target.step(*block), block->count * room}, levels,
                     reinterpret_cast<double *>(memory.data()), square, gram);
            if (end == rows->samples) mirror(gram, n);
            square += levels.k, gram += n * n;
            levels = {0, levels.lower + levels.k, levels.combination + levels.k * n};
        }
    }
}
