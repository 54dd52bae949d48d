// SPDX-License-Identifier: Apache-2.0
// Growable scratch memory that is aligned, zeroed and backed by huge pages where it is large.
#pragma once

#include <cstddef>
#include <utility>

namespace gausslite {

// A replacement for `old` with room for `bytes`, its first `kept` bytes copied and the rest zero; frees `old`, which
// was asked for with `old_bytes`. Throws std::bad_alloc.
void* grow_memory(void* old, size_t kept, size_t old_bytes, size_t bytes);
// Frees what was asked for with `bytes`; the latest large blocks are kept for the next who asks for as much.
void free_memory(void* memory, size_t bytes) noexcept;

// An array that grows and never shrinks. Its members are always inlined: the stages are compiled for several
// instruction sets, and a shared out-of-line copy could be one that this machine cannot run.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer&& other) noexcept
      : data_(std::exchange(other.data_, nullptr)), capacity_(std::exchange(other.capacity_, 0)) {}
  Buffer& operator=(Buffer&&) = delete;
  ~Buffer() { free_memory(data_, capacity_ * sizeof(T)); }

  // Makes room for `count` elements; on growth the first `kept` stay and the others are zero.
  __attribute__((always_inline)) void reserve(size_t count, size_t kept = 0) {
    if (count > capacity_) grow_to(count + count / 4 + 64, kept);
  }
  // The same without headroom, for what never grows again.
  __attribute__((always_inline)) void reserve_exactly(size_t count) {
    if (count > capacity_) grow_to(count, 0);
  }
  __attribute__((always_inline)) T* data() { return data_; }
  __attribute__((always_inline)) const T* data() const { return data_; }
  __attribute__((always_inline)) T& operator[](size_t i) { return data_[i]; }
  __attribute__((always_inline)) const T& operator[](size_t i) const { return data_[i]; }
  __attribute__((always_inline)) size_t capacity() const { return capacity_; }

 private:
  __attribute__((always_inline)) void grow_to(size_t wanted, size_t kept) {
    data_ = static_cast<T*>(grow_memory(data_, kept * sizeof(T), capacity_ * sizeof(T), wanted * sizeof(T)));
    capacity_ = wanted;
  }

  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace gausslite
