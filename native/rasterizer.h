// One picture: from Gaussians to channels and back. Owns what the backward pass needs from the forward pass.
#pragma once
#include "raster.h"

#include <memory>
#include <vector>

namespace polarguide {

// An uninitialized array: pages are touched by the threads that use them.
template <class T> class Buffer {
  public:
    void resize(int64_t count) {
        if (count > capacity_) data_.reset(new T[size_t(count)]), capacity_ = count;
    }
    T *get() const { return data_.get(); }

  private:
    std::unique_ptr<T[]> data_;
    int64_t capacity_ = 0;
};

struct GaussianInputs {
    int64_t count;
    int channels;
    const float *means, *quaternions, *scales, *opacities, *features;
};

class Rasterizer {
  public:
    // `permutation` lists the channels, those of the statistic first.
    Rasterizer(const PinholeCamera &camera, std::vector<int32_t> permutation, int statistic_channels);
    // What a backward pass reads is kept only `for_backward`.
    void forward(const GaussianInputs &in, float *out, float *alpha, float *radius, bool count_pairs, bool for_backward);
    // Of four channels, the last camera depth: their means around each pixel's median depth.
    void surface(const GaussianInputs &in, float width, float *out);
    bool kept() const { return kept_; }
    struct Gradients {
        float *means, *quaternions, *scales, *opacities, *features, *statistic; // statistic may be null
    };
    // A gradient that reaches the features of some channels alone, [H,W,count]; none: `values` is null.
    struct StillGradient {
        const float *values;
        std::vector<int32_t> of_channel; // [channels] which of them each channel gets, -1: none
        int count;
    };
    void backward(const GaussianInputs &in, const float *out, const float *grad_out, const float *grad_alpha,
                  const StillGradient &still, const Gradients &gradients);
    int64_t pairs() const { return pairs_; }
    int64_t instances() const { return instance_count_; }

  private:
    void project(const GaussianInputs &in, float *radius, bool for_backward);
    void bin(int64_t count, bool for_backward);
    // From the visible Gaussians in order of depth, and the tiles that each touches, to each tile's list of them.
    void sort_into_tiles(const std::vector<int32_t> &order, const int32_t *tiles, const int64_t *offset,
                         const int32_t *touched, bool for_backward);
    RasterArgs raster_args(const GaussianInputs &in) const;
    template <class F> void for_tiles(F &&body);

    PinholeCamera camera_;
    std::vector<int32_t> permutation_;
    int statistic_channels_, channels_, tiles_x_, tiles_y_;
    bool kept_ = false;
    int64_t instance_count_ = 0, longest_ = 0, pairs_ = 0;
    Buffer<float> screen_, depth_, transmittance_, rows_;
    Buffer<uint16_t> blocks_;
    Buffer<int32_t> box_, gaussians_;
    Buffer<int64_t> instance_begin_, tile_begin_, instances_;
};

} // namespace polarguide
