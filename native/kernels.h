// Table of functions of each instruction set. Arguments are plain pointers, see CMakeLists.txt.
#pragma once
#include "dispatch.h"

namespace polarguide {

// Declares `name` in the namespace of each instruction set of this build; the active one is selected at run time.
#if defined(POLARGUIDE_X86)
#define POLARGUIDE_DISPATCH(name)                                                                                      \
    (::polarguide::active_isa() == ::polarguide::Isa::avx512 ? ::polarguide::avx512::name                              \
     : ::polarguide::active_isa() == ::polarguide::Isa::avx2 ? ::polarguide::avx2::name                                \
                                                             : ::polarguide::baseline::name)
#define POLARGUIDE_DECLARE(declaration)                                                                                \
    namespace baseline {                                                                                               \
    declaration;                                                                                                       \
    }                                                                                                                  \
    namespace avx2 {                                                                                                   \
    declaration;                                                                                                       \
    }                                                                                                                  \
    namespace avx512 {                                                                                                 \
    declaration;                                                                                                       \
    }
#else
#define POLARGUIDE_DISPATCH(name) (::polarguide::baseline::name)
#define POLARGUIDE_DECLARE(declaration)                                                                                \
    namespace baseline {                                                                                               \
    declaration;                                                                                                       \
    }
#endif

} // namespace polarguide
