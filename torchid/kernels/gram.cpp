#include "gram.h"
#include <algorithm>

namespace {

// Columns that are multiplied with each other at a time, so many that their products fill the registers.
#if defined(__AVX512F__) || defined(__aarch64__)
constexpr Int LEFT = 4, RIGHT = 4;
#else
constexpr Int LEFT = 4, RIGHT = 3;
#endif

// To a register: GCC would load the same numbers again for each product.
inline Lanes load_once(const double *p) {
    Lanes x = load(p);
#ifdef __AVX512F__
    asm("" : "+v"(x));
#endif
    return x;
}

// Add the products of columns i to i + LEFT with columns j to j + RIGHT; beyond the last column, it stands again.
void add_products(const Panel &panel, Int i, Int j, double *gram) {
    const Int last = panel.n - 1;
    const double *left[LEFT], *right[RIGHT];
    for (Int a = 0; a < LEFT; ++a) left[a] = panel.data + std::min(i + a, last) * panel.step;
    for (Int b = 0; b < RIGHT; ++b) right[b] = panel.data + std::min(j + b, last) * panel.step;
    Lanes products[LEFT][RIGHT] = {};
    for (Int t = 0; t < panel.length; t += TILE) {
        Lanes x[LEFT], y[RIGHT];
        for (Int a = 0; a < LEFT; ++a) x[a] = load_once(left[a] + t);
        for (Int b = 0; b < RIGHT; ++b) y[b] = load_once(right[b] + t);
        for (Int a = 0; a < LEFT; ++a)
            for (Int b = 0; b < RIGHT; ++b) products[a][b] += x[a] * y[b];
    }
    double sums[LEFT][RIGHT];
    for (Int a = 0; a < LEFT; ++a)
        for (Int b = 0; b < RIGHT; ++b) sums[a][b] = sum<double>(products[a][b]);
    for (Int a = 0; a < LEFT && i + a <= last; ++a)
        for (Int b = 0; b < RIGHT && j + b <= last; ++b) gram[(i + a) * panel.n + j + b] += sums[a][b];
}

// Write a combination of all columns, with so many factors: 8 groups of lanes at a time.
void combine(const Panel &panel, const double *factors, double *out) {
    constexpr Int GROUPS = 8;
    for (Int start = 0; start < panel.length; start += GROUPS * TILE) {
        const Int groups = std::min(GROUPS, (panel.length - start) / TILE);
        Lanes total[GROUPS] = {};
        for (Int column = 0; column < panel.n; ++column) {
            const double *x = panel.data + column * panel.step + start;
            if (groups == GROUPS)
                for (Int g = 0; g < GROUPS; ++g) total[g] += factors[column] * load(x + g * TILE);
            else
                for (Int g = 0; g < groups; ++g) total[g] += factors[column] * load(x + g * TILE);
        }
        for (Int g = 0; g < groups; ++g) store(out + start + g * TILE, total[g]);
    }
}

} // namespace

void add_gram(const Panel &whole, const Levels &levels, double *scratch, double *squares, double *gram) {
    const Int n = whole.n;
    for (Int start = 0; start < whole.length; start += PANEL) {
        const Panel panel = {whole.data + start, n, whole.step, std::min(PANEL, whole.length - start)};
        for (Int row = 0; row < levels.k; ++row) combine(panel, levels.combination + row * n, scratch + row * PANEL);
        for (Int row = 0; row < levels.k; ++row) {
            double *column = panel.data + levels.lower[row] * panel.step;
            Lanes square = {};
            for (Int t = 0; t < panel.length; t += TILE) {
                const Lanes x = load(column + t);
                square += x * x;
            }
            squares[row] += sum<double>(square);
            std::memcpy(column, scratch + row * PANEL, panel.length * sizeof(double));
        }
        for (Int i = 0; i < n; i += LEFT)
            for (Int j = 0; j < std::min(i + LEFT, n); j += RIGHT) add_products(panel, i, j, gram);
    }
}

void mirror(double *gram, Int n) {
    for (Int i = 0; i < n; ++i)
        for (Int j = 0; j < i; ++j) gram[j * n + i] = gram[i * n + j];
}

// Replace some columns by combinations of all, and write the Gram matrix of all columns, see `Levels`.
//
// columns: (n, first + count), the rows by column; those before the first are left alone.
// squares: (k,), written: sums of squares of the lower columns before.
// gram: (n, n), written.
extern "C" void write_gram(double *columns, Int n, Int first, Int count, Int k, const Int *lower, const double *combination,
                           double *squares, double *gram) {
    std::vector<Lanes> memory(n * PANEL / TILE), scratch(k * PANEL / TILE);
    double *packed = reinterpret_cast<double *>(memory.data());
    std::fill(squares, squares + k, 0.0);
    std::fill(gram, gram + n * n, 0.0);
    for (Int start = 0; start < count; start += PANEL) {
        const Int size = std::min(PANEL, count - start);
        const Panel panel = {packed, n, PANEL, (size + TILE - 1) / TILE * TILE};
        double *rows = columns + first + start;
        for (Int i = 0; i < n; ++i) {
            std::memcpy(packed + i * PANEL, rows + i * (first + count), size * sizeof(double));
            std::fill(packed + i * PANEL + size, packed + i * PANEL + panel.length, 0.0);
        }
        add_gram(panel, {k, lower, combination}, reinterpret_cast<double *>(scratch.data()), squares, gram);
        for (Int row = 0; row < k; ++row)
            std::memcpy(rows + lower[row] * (first + count), packed + lower[row] * PANEL, size * sizeof(double));
    }
    mirror(gram, n);
}
