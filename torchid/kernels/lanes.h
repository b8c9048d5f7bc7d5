// Lanes: one number of each of 8 (float64) or 16 (float32) samples, which the processor handles at once.
// A compiler divides a group among several registers where these are shorter than 64 bytes.
#pragma once
#include <cstring>

template <class T> struct Group;
template <> struct Group<double> { typedef double Type __attribute__((vector_size(64))); };
template <> struct Group<float> { typedef float Type __attribute__((vector_size(64))); };

template <class T> using V = typename Group<T>::Type;
template <class T> constexpr long LANES = 64 / sizeof(T);

// The numbers from `p` on, however it is aligned.
template <class T> inline V<T> load(const T *p) {
    V<T> v;
    std::memcpy(&v, p, sizeof v);
    return v;
}

// The first `n` numbers from `p` on, and zeros.
template <class T> inline V<T> load(const T *p, long n) {
    if (n >= LANES<T>) return load(p);
    V<T> v = {};
    for (long k = 0; k < n; ++k) v[k] = p[k];
    return v;
}

template <class T> inline void store(T *p, const V<T> &v) { std::memcpy(p, &v, sizeof v); }

// Only the first `n` lanes.
template <class T> inline void store(T *p, const V<T> &v, long n) {
    if (n >= LANES<T>) return store(p, v);
    for (long k = 0; k < n; ++k) p[k] = v[k];
}

// One number in all lanes; NaN stays NaN.
template <class T> inline V<T> fill(T x) { return V<T>{} + x; }

// The sum of all lanes, always in the same order.
template <class T> inline T sum(const V<T> &v) {
    T x[LANES<T>];
    std::memcpy(x, &v, sizeof v);
    for (long half = LANES<T> / 2; half > 0; half /= 2)
        for (long k = 0; k < half; ++k) x[k] += x[k + half];
    return x[0];
}
