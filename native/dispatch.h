// Instruction set of the kernels: the best one of the processor, or POLARGUIDE_SIMD=baseline|avx2|avx512.
#pragma once

namespace polarguide {

enum class Isa { baseline, avx2, avx512 };
Isa active_isa();
const char *isa_name(Isa isa);
// Selects by name ("auto", "baseline", "avx2", "avx512"); false if the processor or the build lacks it.
bool select_isa(const char *name);

} // namespace polarguide
