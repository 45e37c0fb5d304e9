// Which instruction set the kernels run with: the best the processor has, or POLARGUIDE_SIMD=baseline|avx2|avx512.
#pragma once

namespace polarguide {

enum class Isa { baseline, avx2, avx512 };
Isa active_isa();
const char *isa_name(Isa isa);
// Chooses by name ("auto", "baseline", "avx2", "avx512"); false when this processor or build lacks it.
bool select_isa(const char *name);

} // namespace polarguide
