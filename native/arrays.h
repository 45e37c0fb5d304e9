// Arguments of the bindings: contiguous float32 arrays on the CPU with checked shapes.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <stdexcept>
#include <string>

namespace polarguide {

using Array = nanobind::ndarray<float, nanobind::c_contig, nanobind::device::cpu>;
using Indices = nanobind::ndarray<int64_t, nanobind::ndim<1>, nanobind::c_contig, nanobind::device::cpu>;

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

// Returns the number of texels along an edge of a cubemap [6,R,R,C]; raises ValueError for other shapes.
inline int64_t cubemap_side(const Array &texture) {
    const int64_t side = texture.ndim() == 4 ? int64_t(texture.shape(1)) : 0;
    expect_shape(texture, "texture", {6, side, side, texture.ndim() == 4 ? int64_t(texture.shape(3)) : 0});
    if (side < 1 || side > 16384) throw std::invalid_argument("texture: expected 1 to 16384 texels along an edge");
    return side;
}

// Raises ValueError unless the indices ascend within [0, count).
inline void expect_ascending(const Indices &indices, const char *name, int64_t count) {
    int64_t least = 0;
    for (size_t i = 0; i < indices.shape(0); ++i) {
        const int64_t index = indices.data()[i];
        if (index < least || index >= count)
            throw std::invalid_argument(std::string(name) + ": expected ascending indices below " + std::to_string(count) +
                                        ", found " + std::to_string(index) + " at " + std::to_string(i));
        least = index + 1;
    }
}

} // namespace polarguide
