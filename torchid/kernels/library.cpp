// What the loader asks of the library before it calls a kernel.
#include "lanes.h"

extern "C" {

// Checksum of the sources that this library is compiled from.
unsigned torchid_checksum() { return TORCHID_CHECKSUM; }

// Samples that a kernel handles at once.
int torchid_lanes() { return LANES<double>; }

// Whether this processor has the instructions that the library is compiled for.
int torchid_supported() {
    int supported = 1;
#if defined(__x86_64__) || defined(__i386__)
    __builtin_cpu_init();
#ifdef __AVX2__
    supported = supported && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi2");
#endif
#ifdef __FMA__
    supported = supported && __builtin_cpu_supports("fma");
#endif
#ifdef __AVX512F__
    supported = supported && __builtin_cpu_supports("avx512f");
#endif
#ifdef __AVX512VL__
    supported = supported && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
                __builtin_cpu_supports("avx512bw");
#endif
#endif
    return supported;
}
}
