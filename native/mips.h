// Mip levels of a cubemap as arguments of the bindings.
#pragma once
#include "arrays.h"
#include "image.h"

#include <vector>

namespace polarguide {

// Returns the textures of a look-up between levels; raises ValueError unless their shapes fit.
inline MipArgs mip_args(const std::vector<Array> &textures) {
    MipArgs a{};
    if (textures.empty() || textures.size() > most_mip_levels)
        throw std::invalid_argument("textures: expected 1 to " + std::to_string(most_mip_levels) + " levels");
    int64_t texels = 0;
    for (const Array &texture : textures) {
        const int64_t side = cubemap_side(texture);
        const int channels = int(texture.shape(3));
        a.channels = a.levels ? a.channels : channels;
        if (channels != a.channels || channels < 1 || channels > largest_mip_channels)
            throw std::invalid_argument("textures: expected the same 1 to " + std::to_string(largest_mip_channels) + " channels");
        a.resolution[a.levels] = int(side), a.textures[a.levels] = texture.data(), a.begin[a.levels] = texels * channels;
        texels += 6 * side * side, ++a.levels;
    }
    return a;
}

inline int64_t texels_of(const MipArgs &a) {
    const int64_t last = a.resolution[a.levels - 1];
    return a.begin[a.levels - 1] / a.channels + 6 * last * last;
}

} // namespace polarguide
