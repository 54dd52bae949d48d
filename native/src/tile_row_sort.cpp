// SPDX-License-Identifier: Apache-2.0
// Sorts the splats of each tile row by depth, after `project`. The keys of a tile row fit the second-level cache, and
// the same thread bins and renders the row next. One sort of the whole image would go through memory.
#include <algorithm>
#include <utility>

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

constexpr int kDigits = 3, kDigitBits = 8, kDigitValues = 1 << kDigitBits;

// Calls f(key) for all keys of the tile row, of all threads, in slot order.
template <class F>
GAUSSLITE_INLINE void for_each_key(const Workspace& ws, int tile_row, F f) {
  for (uint32_t segment = 0; segment < ws.segments; ++segment) {
    const KeyList& list = ws.scratch[ws.segment_thread[segment]].tile_rows[size_t(tile_row)];
    const KeySpan& span = ws.segment_keys[size_t(segment) * size_t(ws.tiles_y) + size_t(tile_row)];
    for (uint32_t i = span.begin; i < span.end; ++i) f(list.keys[i]);
  }
}

struct DepthRange {
  uint32_t nearest = ~0u, farthest = 0;
  int count = 0;
};

DepthRange depth_range(const Workspace& ws, int tile_row) {
  DepthRange range;
  for (const ThreadScratch& scratch : ws.scratch) {
    const KeyList& list = scratch.tile_rows[size_t(tile_row)];
    for (uint32_t i = 0; i < list.count; ++i) {
      range.nearest = std::min(range.nearest, list.keys[i].depth);
      range.farthest = std::max(range.farthest, list.keys[i].depth);
    }
    range.count += int(list.count);
  }
  return range;
}

}  // namespace

// A least-significant-digit radix sort over the 24 highest bits of the depths' range. The bits of a positive float
// increase with its value. The order is exact if the farthest splat of the tile row is less than 4 times as far as the
// nearest. Below 16 times, it ignores the lowest mantissa bit; below 256 times, the lowest two (3.6e-7 of the depth).
// The sort is stable: equal keys keep the order of the rows.
const DepthKey* sort_tile_row(Workspace& ws, int tile_row, int thread, int& count) {
  const DepthRange range = depth_range(ws, tile_row);
  count = range.count;
  if (count == 0) return nullptr;
  ThreadScratch& thread_scratch = ws.scratch[size_t(thread)];
  for (Buffer<DepthKey>& buffer : thread_scratch.sorted) buffer.ensure_capacity(size_t(count) + kPrefetchAhead);
  const int shift = std::max(0, 32 - kDigits * kDigitBits - __builtin_clz((range.farthest - range.nearest) | 1u));

  uint32_t position[kDigits][kDigitValues] = {};
  DepthKey* from = thread_scratch.sorted[0].data();
  DepthKey* to = thread_scratch.sorted[1].data();
  int filled = 0;
  for_each_key(ws, tile_row, [&](const DepthKey& key) {
    const uint32_t depth = (key.depth - range.nearest) >> shift;
    from[filled++] = {depth, key.slot};
    ++position[0][depth & 255u];
    ++position[1][depth >> 8 & 255u];
    ++position[2][depth >> 16];
  });
  for (int digit = 0; digit < kDigits; ++digit) {
    uint32_t start = 0;
    for (uint32_t& p : position[digit]) start += std::exchange(p, start);
    for (int i = 0; i < count; ++i) to[position[digit][from[i].depth >> (kDigitBits * digit) & 255u]++] = from[i];
    std::swap(from, to);
  }
  // bin_tile_row prefetches this far ahead: behind the last key, it prefetches the last splat again.
  for (int i = 0; i < kPrefetchAhead; ++i) from[count + i] = from[count - 1];
  return from;
}

}  // namespace gausslite::GAUSSLITE_ISA
