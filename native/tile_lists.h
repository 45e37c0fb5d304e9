// Lists of the Gaussians in each tile of a picture, in order of depth.
#pragma once
#include "buffer.h"
#include "raster.h"

namespace polarguide {

class TileLists {
  public:
    // Sorts the tiles that each of `count` Gaussians touches. Each pair of a Gaussian and a tile has a number. Numbers of Gaussian g
    // begin at first[g], row by row. The lists do not depend on the number of threads. `instances` exist only with `for_backward`.
    void sort(const TileEmitArgs &emitted, const float *depth, const int64_t *first, int64_t count, int tiles_x, int tiles_y,
              bool for_backward);

    const int64_t *begin() const { return begin_.get(); }            // [tiles + 1] first entry of each tile's list
    const int32_t *gaussians() const { return gaussians_.get(); }    // Gaussian of each entry
    const int64_t *instances() const { return instances_.get(); }    // number of each pair
    int64_t longest() const { return longest_; }

  private:
    Buffer<int64_t> begin_, instances_;
    Buffer<int32_t> gaussians_;
    int64_t longest_ = 0;
};

} // namespace polarguide
