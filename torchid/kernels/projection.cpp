// Null-space bases of unmeasured forces, and dynamics projected with them: 8 doubles or 16 floats of as many samples at
// a time. Every sample has a basis of m columns. Those that its contacts take away are zero.

#include "lanes.h"
#include "threads.h"

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

using Index = int64_t;
constexpr Index GROUPS = 4; // groups of lanes whose entries of K are read one after the other: they lie side by side

template <class T> struct Project { // arguments of a call; strides in numbers
    const T *J, *row_std, *wrench_std, *torque, *wrench, *K;
    const bool *active;
    const Index *kept, *unmeasured, *measured; // rows of the dynamics, and of J
    Index samples, rows, base, k, m, n_unmeasured, n_measured, columns, K_sample, K_row, K_column;
    const double *negligible; // singular values: an absolute one, and a share of the largest
    T *V, *K_out, *f;         // (samples, rows, m), (samples, m, columns), (samples, m)
    bool *suspect;            // samples that may have lost rank: their basis is not to be used
};

// Numbers of J of some lanes, zero where a contact is not active
template <class T> struct Contact {
    const Project<T> &p;
    Index first, count;
    V<T> active(Index i) const {
        V<T> out{};
        for (Index s = 0; s < count; ++s) out[s] = p.active[(first + s) * p.k + i];
        return out;
    }
    V<T> at(Index i, Index row) const { // of an active row
        V<T> out{};
        for (Index s = 0; s < count; ++s)
            if (p.active[(first + s) * p.k + i]) out[s] = p.J[((first + s) * p.k + i) * p.rows + row];
        return out;
    }
};

// Householder reflections of the unmeasured rows A, one each, over the columns that none before has taken; then the
// columns of their product that are left. Sets the lanes that may have lost rank.
template <class T> void null_basis(const Contact<T> &contact, std::vector<V<T>> &W, bool *suspect) {
    const Project<T> &p = contact.p;
    const Index m = p.m, k = p.n_unmeasured;
    std::vector<V<T>> A(k * m), R(k * k), inverse(k * k), free(m, fill<T>(1)), tau(k), used(k);
    V<T> size{};
    for (Index i = 0; i < k; ++i) {
        V<T> *x = &A[i * m];
        used[i] = contact.active(p.unmeasured[i]);
        for (Index c = 0; c < m; ++c) x[c] = contact.at(p.unmeasured[i], p.kept[c]) / p.row_std[c], size += x[c] * x[c];
        for (Index h = 0; h < i; ++h) {
            V<T> along{};
            for (Index c = 0; c < m; ++c) along += A[h * m + c] * x[c];
            along *= tau[h];
            for (Index c = 0; c < m; ++c) x[c] -= along * A[h * m + c];
            R[h * k + i] = x[h] * used[h];
        }
        V<T> square{};
        for (Index c = 0; c < m; ++c) x[c] *= free[c], square += x[c] * x[c];
        V<T> length = square_root<T>(square);
        for (Index s = 0; s < LANES<T>; ++s) length[s] = std::copysign(length[s], -x[i][s]);
        R[i * k + i] = length;
        x[i] -= length;
        const V<T> norm = square - (x[i] + length) * (x[i] + length) + x[i] * x[i];
        for (Index s = 0; s < LANES<T>; ++s) tau[i][s] = norm[s] > 0 ? 2 / norm[s] : 0;
        free[i] -= used[i];
    }
    V<T> spread{}; // of R^-1, squared, over the rows of active contacts
    for (Index i = 0; i < k; ++i) {
        for (Index s = 0; s < LANES<T>; ++s) inverse[i * k + i][s] = used[i][s] > 0 ? 1 / R[i * k + i][s] : 0;
        for (Index j = i; j-- > 0;) {
            V<T> sum{};
            for (Index h = j + 1; h <= i; ++h) sum += R[j * k + h] * inverse[h * k + i];
            inverse[j * k + i] = -sum * inverse[j * k + j];
        }
        for (Index j = 0; j <= i; ++j) spread += inverse[j * k + i] * inverse[j * k + i];
    }
    for (Index s = 0; s < contact.count; ++s) {
        const T negligible = T(std::max(p.negligible[0], p.negligible[1] * std::sqrt(double(size[s]))));
        suspect[s] = k > 0 && !(negligible * std::sqrt(spread[s]) < T(1e-3)); // so written, NaN is suspect
    }
    std::fill(W.begin(), W.end(), V<T>{});
    for (Index c = 0; c < m; ++c) W[c * m + c] = free[c];
    std::vector<V<T>> along(m);
    for (Index h = k; h-- > 0;) {
        std::fill(along.begin(), along.end(), V<T>{});
        for (Index c = 0; c < m; ++c)
            for (Index j = 0; j < m; ++j) along[j] += A[h * m + c] * W[c * m + j];
        for (Index c = 0; c < m; ++c)
            for (Index j = 0; j < m; ++j) W[c * m + j] -= tau[h] * A[h * m + c] * along[j];
    }
    for (Index c = 0; c < m; ++c)
        for (Index j = 0; j < m; ++j) W[c * m + j] /= p.row_std[c];
}

// Make a basis white under the noise of measured contact forces: divide by the Cholesky factor of 1 + M^T M
template <class T> void whiten(const Contact<T> &contact, std::vector<V<T>> &W) {
    const Project<T> &p = contact.p;
    const Index m = p.m;
    std::vector<V<T>> L(m * m), along(m);
    for (Index j = 0; j < m; ++j) L[j * m + j] = fill<T>(1);
    for (Index i = 0; i < p.n_measured; ++i) {
        std::fill(along.begin(), along.end(), V<T>{});
        for (Index c = 0; c < m; ++c) {
            const V<T> x = contact.at(p.measured[i], p.kept[c]) * p.wrench_std[i];
            for (Index j = 0; j < m; ++j) along[j] += x * W[c * m + j];
        }
        for (Index j = 0; j < m; ++j)
            for (Index h = 0; h <= j; ++h) L[j * m + h] += along[j] * along[h];
    }
    for (Index j = 0; j < m; ++j) {
        for (Index h = 0; h < j; ++h) {
            for (Index g = 0; g < h; ++g) L[j * m + h] -= L[j * m + g] * L[h * m + g];
            L[j * m + h] /= L[h * m + h];
            L[j * m + j] -= L[j * m + h] * L[j * m + h];
        }
        L[j * m + j] = square_root<T>(L[j * m + j]);
    }
    for (Index c = 0; c < m; ++c)
        for (Index j = 0; j < m; ++j) {
            for (Index h = 0; h < j; ++h) W[c * m + j] -= W[c * m + h] * L[j * m + h];
            W[c * m + j] /= L[j * m + j];
        }
}

template <class T> bool any(const V<T> *x) { // whether bits of a row of X are set: -0 and NaN count
    constexpr Index WORDS = LANES<T> * sizeof(V<T>) / sizeof(uint64_t);
    uint64_t words[WORDS], out = 0;
    std::memcpy(words, x, sizeof words);
    for (uint64_t word : words) out |= word;
    return out;
}

// Products of a basis, m columns, with some vectors X, (m, N): (m, N). Rows of zeros, of which K has many, are left out.
template <class T> void multiply(const std::vector<V<T>> &W, const std::vector<V<T>> &X, std::vector<Index> &rows,
                                 std::vector<V<T>> &out) {
    constexpr Index N = LANES<T>;
    const Index m = Index(rows.size());
    Index n = 0;
    for (Index c = 0; c < m; ++c)
        if (any<T>(&X[c * N])) rows[n++] = c;
    for (Index j = 0; j < m; ++j) {
        V<T> sums[N] = {};
        for (Index r = 0; r < n; ++r)
            for (Index k = 0; k < N; ++k) sums[k] += W[rows[r] * m + j] * X[rows[r] * N + k];
        for (Index k = 0; k < N; ++k) out[j * N + k] = sums[k];
    }
}

template <class T> void project(const Project<T> &p, Index begin, Index end) {
    constexpr Index N = LANES<T>;
    const Index m = p.m, joints = p.rows - p.base;
    std::vector<std::vector<V<T>>> bases(GROUPS, std::vector<V<T>>(m * m));
    std::vector<V<T>> X(m * N), products(m * N);
    std::vector<Index> rows(m);
    const T *made = reinterpret_cast<const T *>(products.data());
    for (Index start = begin; start < end; start += GROUPS * N) {
        const Index used = std::min(GROUPS, (end - start + N - 1) / N);
        for (Index g = 0; g < used; ++g) {
            const Index first = start + g * N, count = std::min(N, end - first);
            const Contact<T> contact{p, first, count};
            null_basis(contact, bases[g], p.suspect + first);
            if (p.wrench_std) whiten(contact, bases[g]);
            std::fill(X.begin(), X.end(), V<T>{});
            for (Index c = 0; c < m; ++c) {
                for (Index s = 0; s < count; ++s)
                    for (Index j = 0; j < m; ++j)
                        p.V[((first + s) * p.rows + p.kept[c]) * m + j] = bases[g][c * m + j][s];
                V<T> &force = X[c * N];
                if (p.kept[c] >= p.base) force = gather(p.torque + first * joints + p.kept[c] - p.base, joints, count);
                for (Index i = 0; i < p.n_measured; ++i) {
                    const V<T> push = gather(p.wrench + first * p.k + p.measured[i], p.k, count);
                    const V<T> J = contact.at(p.measured[i], p.kept[c]);
                    for (Index s = 0; s < count; ++s)
                        force[s] += J[s] == 0 ? 0 : J[s] * push[s]; // what is not read may be NaN
                }
            }
            multiply<T>(bases[g], X, rows, products);
            for (Index s = 0; s < count; ++s)
                for (Index j = 0; j < m; ++j) p.f[(first + s) * m + j] = made[j * N * N + s];
        }
        for (Index column = 0; column < p.columns; column += N)
            for (Index g = 0; g < used; ++g) {
                const Index first = start + g * N, count = std::min(N, end - first),
                            width = std::min(N, p.columns - column);
                for (Index c = 0; c < m; ++c) {
                    const T *K = p.K + first * p.K_sample + p.kept[c] * p.K_row + column * p.K_column;
                    for (Index k = 0; k < width; ++k, K += p.K_column) {
                        X[c * N + k] = gather(K, p.K_sample, count);
                        __builtin_prefetch(K + N * p.K_column);
                    }
                }
                multiply<T>(bases[g], X, rows, products);
                for (Index s = 0; s < count; ++s) // whole lines of memory at a time
                    for (Index j = 0; j < m; ++j) {
                        T *to = p.K_out + ((first + s) * m + j) * p.columns + column;
                        __builtin_prefetch(to + N, 1);
                        for (Index k = 0; k < width; ++k) to[k] = made[(j * N + k) * N + s];
                    }
            }
    }
}

} // namespace

extern "C" {
void torchid_projection_float64(const Project<double> *p, Index threads) {
    in_threads(p->samples, GROUPS * LANES<double>, threads, [&](Index a, Index b) { project(*p, a, b); });
}
void torchid_projection_float32(const Project<float> *p, Index threads) {
    in_threads(p->samples, GROUPS * LANES<float>, threads, [&](Index a, Index b) { project(*p, a, b); });
}
}
