// What the bindings take: contiguous float32 arrays on the CPU, with their shapes checked.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <stdexcept>
#include <string>

namespace polarguide {

using Array = nanobind::ndarray<float, nanobind::c_contig, nanobind::device::cpu>;

// Raises ValueError unless the array has this shape.
inline void expect_shape(const Array &array, const char *name, std::initializer_list<int64_t> shape) {
    bool same = array.ndim() == shape.size();
    std::string wanted, found;
    size_t axis = 0;
    for (int64_t n : shape) {
        if (same && int64_t(array.shape(axis)) != n) same = false;
        wanted += (axis++ ? ", " : "") + std::to_string(n);
    }
    if (same) return;
    for (size_t i = 0; i < array.ndim(); ++i) found += (i ? ", " : "") + std::to_string(array.shape(i));
    throw std::invalid_argument(std::string(name) + ": expected shape [" + wanted + "], found [" + found + "]");
}

} // namespace polarguide
