// SPDX-License-Identifier: Apache-2.0
// Growable scratch memory: aligned, zeroed, and on huge pages if large.
#pragma once

#include <cstddef>
#include <utility>

namespace gausslite {

// Returns `bytes` bytes of memory: a copy of the first `preserved_bytes` of `old`, then zeros. Frees `old`, which has
// `old_bytes`. Throws std::bad_alloc.
void* reallocate(void* old, size_t preserved_bytes, size_t old_bytes, size_t bytes);
// Frees `memory`, which has `bytes` bytes. The two latest large blocks are cached for requests of the same size.
void free_memory(void* memory, size_t bytes) noexcept;

// An array that grows and never shrinks. Its members are always inlined: the stages are compiled for several
// instruction sets, and a shared out-of-line copy could use one that this machine lacks.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer&& other) noexcept
      : data_(std::exchange(other.data_, nullptr)), capacity_(std::exchange(other.capacity_, 0)) {}
  Buffer& operator=(Buffer&&) = delete;
  ~Buffer() { free_memory(data_, capacity_ * sizeof(T)); }

  // Ensures a capacity of `count` elements. Growth copies the first `preserved` elements, sets all others to zero and
  // adds spare capacity.
  __attribute__((always_inline)) void ensure_capacity(size_t count, size_t preserved = 0) {
    if (count > capacity_) grow_to(count + count / 4 + 64, preserved);
  }
  // The same for arrays of final size: growth adds no spare capacity and sets all elements to zero.
  __attribute__((always_inline)) void ensure_exact_capacity(size_t count) {
    if (count > capacity_) grow_to(count, 0);
  }
  __attribute__((always_inline)) T* data() { return data_; }
  __attribute__((always_inline)) const T* data() const { return data_; }
  __attribute__((always_inline)) T& operator[](size_t i) { return data_[i]; }
  __attribute__((always_inline)) const T& operator[](size_t i) const { return data_[i]; }
  __attribute__((always_inline)) size_t capacity() const { return capacity_; }

 private:
  __attribute__((always_inline)) void grow_to(size_t needed, size_t preserved) {
    data_ = static_cast<T*>(reallocate(data_, preserved * sizeof(T), capacity_ * sizeof(T), needed * sizeof(T)));
    capacity_ = needed;
  }

  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace gausslite
