// Lanes: one number of each of some samples, 2 to 8 of float64, as many as fill a register of the processor.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
constexpr int REGISTER = 64; // bytes
#elif defined(__AVX__)
constexpr int REGISTER = 32;
#else
constexpr int REGISTER = 16;
#endif

template <class T> struct Group;
template <> struct Group<double> { typedef double Type __attribute__((vector_size(REGISTER))); };
template <> struct Group<float> { typedef float Type __attribute__((vector_size(REGISTER))); };

template <class T> using V = typename Group<T>::Type;
template <class T> constexpr std::int64_t LANES = REGISTER / sizeof(T);

// The numbers from `p` on, however it is aligned.
template <class T> inline V<T> load(const T *p) {
    V<T> v = {};
    std::memcpy(&v, p, sizeof v);
    return v;
}

// The first `n` numbers from `p` on, and zeros.
template <class T> inline V<T> load(const T *p, std::int64_t n) {
    if (n >= LANES<T>) return load(p);
    V<T> v = {};
    for (std::int64_t k = 0; k < n; ++k) v[k] = p[k];
    return v;
}

// The first `n` of the numbers that lie `step` apart, and zeros.
template <class T> inline V<T> gather(const T *p, std::int64_t step, std::int64_t n) {
    if (step == 1) return load(p, n);
    T x[LANES<T>] = {};
    if (n < LANES<T>)
        for (std::int64_t k = 0; k < n; ++k) x[k] = p[k * step];
    else
        for (std::int64_t k = 0; k < LANES<T>; ++k) x[k] = p[k * step];
    return load(x);
}

template <class T> inline void store(T *p, const V<T> &v) { std::memcpy(p, &v, sizeof v); }

// Only the first `n` lanes.
template <class T> inline void store(T *p, const V<T> &v, std::int64_t n) {
    if (n >= LANES<T>) return store(p, v);
    for (std::int64_t k = 0; k < n; ++k) p[k] = v[k];
}

// One number in all lanes; NaN stays NaN.
template <class T> inline V<T> fill(T x) { return V<T>{} + x; }

template <class T> inline V<T> square_root(V<T> x) {
    for (std::int64_t k = 0; k < LANES<T>; ++k) x[k] = std::sqrt(x[k]);
    return x;
}

// The sum of all lanes, always in the same order.
template <class T> inline T sum(const V<T> &v) {
    T x[LANES<T>];
    std::memcpy(x, &v, sizeof v);
    for (std::int64_t half = LANES<T> / 2; half > 0; half /= 2)
        for (std::int64_t k = 0; k < half; ++k) x[k] += x[k + half];
    return x[0];
}
