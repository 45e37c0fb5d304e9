#include "dispatch.h"
#include "parallel.h"

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <stdexcept>
#include <string>

namespace nb = nanobind;

void bind_raster(nb::module_ &module);
void bind_image(nb::module_ &module);
void bind_gaussians(nb::module_ &module);
void bind_reflect(nb::module_ &module);
void bind_terms(nb::module_ &module);

NB_MODULE(_native, module) {
    nb::set_leak_warnings(false); // autograd graphs may outlive the interpreter
    module.doc() = "CPU kernels of polarguide.";
    module.def("thread_count", &polarguide::thread_count, "Return the number of threads of the kernels.");
    module.def("set_thread_count", &polarguide::set_thread_count, nb::arg("threads"),
               "Set the number of threads; 0 restores the default.");
    module.def("simd", [] { return std::string(polarguide::isa_name(polarguide::active_isa())); },
               "Return the name of the active instruction set.");
    module.def(
        "select_simd",
        [](const std::string &name) {
            if (!polarguide::select_isa(name.c_str()))
                throw std::invalid_argument("instruction set '" + name + "' is not available on this processor");
        },
        nb::arg("name"), "Choose 'auto', 'baseline', 'avx2' or 'avx512'.");
    bind_raster(module);
    bind_image(module);
    bind_gaussians(module);
    bind_reflect(module);
    bind_terms(module);
}
