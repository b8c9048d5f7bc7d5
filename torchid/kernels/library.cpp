// What the loader asks of the library before it calls a kernel.
#include "lanes.h"

extern "C" {

// Checksum of the sources that this library is compiled from.
unsigned torchid_checksum() { return TORCHID_CHECKSUM; }

// Samples that a kernel handles at once.
int torchid_lanes() { return LANES<double>; }

// Whether this processor has the instructions that the library is compiled for.
int torchid_supported() {
#ifdef __AVX512F__
    if (!__builtin_cpu_supports("avx512f")) return 0;
#endif
#ifdef __AVX512VL__
    if (!__builtin_cpu_supports("avx512vl") || !__builtin_cpu_supports("avx512dq")) return 0;
    if (!__builtin_cpu_supports("avx512bw")) return 0;
#endif
#ifdef __AVX2__
    if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("bmi2")) return 0;
#endif
#ifdef __FMA__
    if (!__builtin_cpu_supports("fma")) return 0;
#endif
    return 1;
}
}
