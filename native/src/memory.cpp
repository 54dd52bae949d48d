// SPDX-License-Identifier: Apache-2.0
#include "memory.h"

#include <cstdlib>
#include <cstring>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace gausslite {

namespace {

constexpr size_t kCacheLine = 64;
constexpr size_t kHugePage = size_t{2} << 20;

}  // namespace

// Random 64-byte reads run about twice as fast from 2 MiB pages as from 4 KiB pages, so large arrays ask for them.
void* grow_memory(void* old, size_t kept, size_t bytes) {
  const size_t alignment = bytes >= kHugePage / 2 ? kHugePage : kCacheLine;
  const size_t rounded = (bytes + alignment - 1) / alignment * alignment;
  void* fresh = std::aligned_alloc(alignment, rounded);
  if (fresh == nullptr) throw std::bad_alloc();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  if (alignment == kHugePage) madvise(fresh, rounded, MADV_HUGEPAGE);
#endif
  if (kept > 0) std::memcpy(fresh, old, kept);
  std::memset(static_cast<char*>(fresh) + kept, 0, rounded - kept);
  std::free(old);
  return fresh;
}

void free_memory(void* p) noexcept { std::free(p); }

}  // namespace gausslite
