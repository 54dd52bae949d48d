// SPDX-License-Identifier: Apache-2.0
// Stage 2: the splats of one row of tiles, nearest first. A strip's keys fit the second-level cache, and its thread
// goes on to bin and draw it while they are there; one sort of the whole image would go through memory instead.
#include <algorithm>
#include <utility>

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

constexpr int kDigits = 3, kDigitBits = 8, kDigitValues = 1 << kDigitBits;

// Calls f(key) for all keys of the strip in the order of their slots, whichever threads found them.
template <class F>
GAUSSLITE_INLINE void for_each_key(const Workspace& ws, int strip, F f) {
  for (uint32_t segment = 0; segment < ws.segments; ++segment) {
    const KeyList& list = ws.scratch[ws.segment_thread[segment]].strips[size_t(strip)];
    const KeySpan& span = ws.segment_keys[size_t(segment) * size_t(ws.tiles_y) + size_t(strip)];
    for (uint32_t i = span.begin; i < span.end; ++i) f(list.keys[i]);
  }
}

struct DepthRange {
  uint32_t nearest = ~0u, farthest = 0;
  int count = 0;
};

DepthRange depth_range(const Workspace& ws, int strip) {
  DepthRange range;
  for (const ThreadScratch& scratch : ws.scratch) {
    const KeyList& list = scratch.strips[size_t(strip)];
    for (uint32_t i = 0; i < list.count; ++i) {
      range.nearest = std::min(range.nearest, list.keys[i].depth);
      range.farthest = std::max(range.farthest, list.keys[i].depth);
    }
    range.count += int(list.count);
  }
  return range;
}

}  // namespace

// A least-significant-digit radix sort over 24 bits: the bits of a positive float grow with the float, and rebased to
// the strip's nearest splat 24 of them resolve depth to about 3e-7. It is stable, so equal depths keep the order of the
// rows.
const DepthKey* sort_strip(Workspace& ws, int strip, int thread, int& count) {
  const DepthRange range = depth_range(ws, strip);
  count = range.count;
  if (count == 0) return nullptr;
  ThreadScratch& mine = ws.scratch[size_t(thread)];
  for (Buffer<DepthKey>& buffer : mine.sorted) buffer.reserve(size_t(count) + kPrefetchAhead);
  const int shift = std::max(0, 32 - kDigits * kDigitBits - __builtin_clz((range.farthest - range.nearest) | 1u));

  uint32_t position[kDigits][kDigitValues] = {};
  DepthKey* from = mine.sorted[0].data();
  DepthKey* to = mine.sorted[1].data();
  int filled = 0;
  for_each_key(ws, strip, [&](const DepthKey& key) {
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
  for (int i = 0; i < kPrefetchAhead; ++i) from[count + i] = from[count - 1];
  return from;
}

}  // namespace gausslite::GAUSSLITE_ISA
