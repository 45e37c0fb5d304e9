#include "dispatch.h"

#include <cstdlib>
#include <cstring>
#include <initializer_list>
#if defined(_WIN32)
#include <intrin.h>
#endif

namespace polarguide {
namespace {

#if defined(_WIN32) && defined(POLARGUIDE_X86)
// Clang's __builtin_cpu_supports needs a library that Microsoft's linker does not find, so bits of CPUID's leaves 1 and 7 are read.
__attribute__((target("xsave"))) bool available(Isa isa) {
    if (isa == Isa::baseline) return true;
    int one[4], seven[4];
    __cpuid(one, 1);
    __cpuidex(seven, 7, 0);
    const unsigned c = unsigned(one[2]), b = unsigned(seven[1]);
    auto all = [](unsigned value, std::initializer_list<int> bits) {
        for (int bit : bits)
            if (!(value >> bit & 1)) return false;
        return true;
    };
    if (!all(c, {12, 27, 28})) return false; // FMA, OSXSAVE, AVX
    const unsigned saved = unsigned(_xgetbv(0)); // registers that the system saves for a process
    if (isa == Isa::avx2) return all(saved, {1, 2}) && all(b, {3, 5, 8}); // BMI1, AVX2, BMI2
    return all(saved, {1, 2, 5, 6, 7}) && all(b, {16, 17, 28, 30, 31}); // AVX-512 F, DQ, CD, BW, VL
}
#else
bool available(Isa isa) {
    if (isa == Isa::baseline) return true;
#if defined(POLARGUIDE_X86)
    __builtin_cpu_init();
    if (isa == Isa::avx2)
        return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
#else
    return false;
#endif
}
#endif

Isa best() {
    if (available(Isa::avx512)) return Isa::avx512;
    if (available(Isa::avx2)) return Isa::avx2;
    return Isa::baseline;
}

Isa initial() {
    Isa isa = best();
    if (const char *name = std::getenv("POLARGUIDE_SIMD"))
        for (Isa wanted : {Isa::baseline, Isa::avx2, Isa::avx512})
            if (std::strcmp(name, isa_name(wanted)) == 0 && available(wanted)) isa = wanted;
    return isa;
}

Isa &current() {
    static Isa isa = initial();
    return isa;
}

} // namespace

Isa active_isa() { return current(); }

const char *isa_name(Isa isa) {
    return isa == Isa::avx512 ? "avx512" : isa == Isa::avx2 ? "avx2" : "baseline";
}

bool select_isa(const char *name) {
    if (std::strcmp(name, "auto") == 0) {
        current() = best();
        return true;
    }
    for (Isa wanted : {Isa::baseline, Isa::avx2, Isa::avx512})
        if (std::strcmp(name, isa_name(wanted)) == 0 && available(wanted)) {
            current() = wanted;
            return true;
        }
    return false;
}

} // namespace polarguide
