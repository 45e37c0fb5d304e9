#include "dispatch.h"

#include <cstdlib>
#include <cstring>
#include <initializer_list>

namespace polarguide {
namespace {

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
