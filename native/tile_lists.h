// Which Gaussians each tile of a picture blends, in order of depth.
#pragma once
#include "buffer.h"
#include "raster.h"

namespace polarguide {

class TileLists {
  public:
    // From the tiles that each of `count` Gaussians touches. Each pair of a Gaussian and a tile has a number: those of
    // Gaussian g begin at first[g], row by row. The lists are the same for any number of threads. Only `for_backward` are
    // there `instances`.
    void sort(const TileEmitArgs &emitted, const float *depth, const int64_t *first, int64_t count, int tiles_x, int tiles_y,
              bool for_backward);

    const int64_t *begin() const { return begin_.get(); }            // [tiles + 1] where a tile's list begins
    const int32_t *gaussians() const { return gaussians_.get(); }    // whom it lists
    const int64_t *instances() const { return instances_.get(); }    // and the number of each such pair
    int64_t longest() const { return longest_; }

  private:
    Buffer<int64_t> begin_, instances_;
    Buffer<int32_t> gaussians_;
    int64_t longest_ = 0;
};

} // namespace polarguide
