// Rasterizer of one picture, from Gaussians to channels and back. It owns the data of the forward pass for the backward pass.
#pragma once
#include "buffer.h"
#include "raster.h"
#include "tile_lists.h"

#include <vector>

namespace polarguide {

struct GaussianInputs {
    int64_t count;
    int channels;
    const float *means, *quaternions, *scales, *opacities, *features;
};

class Rasterizer {
  public:
    // `permutation` lists the channels, with channels of the statistic first.
    Rasterizer(const PinholeCamera &camera, std::vector<int32_t> permutation, int statistic_channels);
    // Data for the backward pass is stored only with `for_backward`.
    void forward(const GaussianInputs &in, float *out, float *alpha, float *radius, bool count_pairs, bool for_backward);
    // Computes the means of four channels, the last one camera depth, around the median depth of each pixel.
    void surface(const GaussianInputs &in, float width, float *out);
    bool kept() const { return kept_; }
    struct Gradients {
        float *means, *quaternions, *scales, *opacities, *features, *statistic; // statistic may be null
    };
    // Gradient of some channels' features alone, [H,W,count]; `values` is null without it.
    struct StillGradient {
        const float *values;
        std::vector<int32_t> of_channel; // [channels] channel of `values` for each channel; -1: none
        int count;
    };
    void backward(const GaussianInputs &in, const float *out, const float *grad_out, const float *grad_alpha,
                  const StillGradient &still, const Gradients &gradients);
    int64_t pairs() const { return pairs_; }
    int64_t instances() const { return instance_count_; }

  private:
    void project(const GaussianInputs &in, float *radius, bool for_backward);
    void bin(int64_t count, bool for_backward);
    RasterArgs raster_args(const GaussianInputs &in) const;
    template <class F> void for_tiles(F &&body);

    PinholeCamera camera_;
    std::vector<int32_t> permutation_;
    int statistic_channels_, channels_, tiles_x_, tiles_y_;
    bool kept_ = false;
    int64_t instance_count_ = 0, pairs_ = 0;
    TileLists lists_;
    Buffer<float> screen_, depth_, transmittance_, rows_;
    Buffer<uint16_t> blocks_;
    Buffer<int32_t> box_;
    Buffer<int64_t> instance_begin_;
};

} // namespace polarguide
