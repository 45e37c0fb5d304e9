// Which Gaussians each tile of a picture blends, in order of depth.
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

class TileLists {
  public:
    // From the tiles that each of `count` Gaussians touches, all of which have a number: those of a Gaussian begin at
    // `first`, by rows. The lists are the same for any number of threads. Only `for_backward` are there `instances`.
    void sort(const TileEmitArgs &emitted, const float *depth, const int64_t *first, int64_t count, int tiles_x, int tiles_y,
              bool for_backward);

    const int64_t *begin() const { return begin_.get(); }            // [tiles + 1] where a tile's list begins
    const int32_t *gaussians() const { return gaussians_.get(); }    // whom it lists
    const int64_t *instances() const { return instances_.get(); }    // and the number of what they touch there
    int64_t longest() const { return longest_; }

  private:
    Buffer<int64_t> begin_, instances_;
    Buffer<int32_t> gaussians_;
    int64_t longest_ = 0;
};

} // namespace polarguide
