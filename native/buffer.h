#pragma once
#include <memory>
#include <stdint.h>

namespace polarguide {

// Uninitialized array; its pages are first touched by the threads that use them.
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

} // namespace polarguide
