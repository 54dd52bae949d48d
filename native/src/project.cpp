// SPDX-License-Identifier: Apache-2.0
// Stage 1: parameter rows to visible splats, and their depth keys to the tile rows that they touch.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "candidates.h"
#include "projection.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// The 4x4 blocks of the pixels whose centres are in the bounding box of alpha >= 1/255, both ends included.
struct Box {
  Pack16 block_x0, block_x1, block_y0, block_y1;
  Mask16 visible, elongated;

  GAUSSLITE_INLINE Box(const Projection& p, const Camera& camera) {
    const Pack16 above = p.log2_opacity - kLog2MinAlpha, zero(0.0f);
    const Pack16 square = max(above * (2.0f * kLn2), zero);
    const Pack16 reach_x = sqrt(square * p.cov_xx), reach_y = sqrt(square * p.cov_yy);
    const Pack16 x0 = max(ceil(p.mean_x - reach_x - 0.5f), zero);
    const Pack16 y0 = max(ceil(p.mean_y - reach_y - 0.5f), zero);
    const Pack16 x1 = min(floor(p.mean_x + reach_x - 0.5f), Pack16(float(camera.width - 1)));
    const Pack16 y1 = min(floor(p.mean_y + reach_y - 0.5f), Pack16(float(camera.height - 1)));
    visible = (above > zero) & (x0 <= x1) & (y0 <= y1);

    block_x0 = floor(x0 * 0.25f);
    block_x1 = floor(x1 * 0.25f);
    block_y0 = floor(y0 * 0.25f);
    block_y1 = floor(y1 * 0.25f);
    // In a box of one row or column, or of four blocks with a roundish splat, the exact test would save less than it
    // costs.
    const Pack16 across = block_x1 - block_x0, down = block_y1 - block_y0, one(1.0f);
    const Mask16 slanted = p.cov_xy * p.cov_xy > p.cov_xx * p.cov_yy * 0.3f;
    const Mask16 many = (across + one) * (down + one) > Pack16(4.0f);
    elongated = (across > zero) & (down > zero) & (slanted | many);
  }
};

// Rows with a NaN or infinite parameter, and splats whose projection overflows, are not drawn at all.
GAUSSLITE_INLINE Mask16 is_sound(const Pack16* row, const Projection& p) {
  Pack16 total = row[0] * 0.0f;
  for (int k = 1; k < kTrained; ++k) total = fma(row[k], Pack16(0.0f), total);
  const Pack16 conic = p.conic_xx * 0.0f + p.conic_xy * 0.0f + p.conic_yy * 0.0f;
  const Pack16 shape = p.mean_x * 0.0f + p.mean_y * 0.0f + p.cov_xx * 0.0f + p.cov_yy * 0.0f;
  return (total + conic + shape == Pack16(0.0f)) & (p.conic_xx > Pack16(0.0f)) & (p.conic_yy > Pack16(0.0f));
}

// The box in whole blocks, lane by lane.
struct BoxLanes {
  alignas(64) int32_t x0[16], x1[16], y0[16], y1[16];

  GAUSSLITE_INLINE explicit BoxLanes(const Box& box) {
    store_int(x0, box.block_x0);
    store_int(x1, box.block_x1);
    store_int(y0, box.block_y0);
    store_int(y1, box.block_y1);
  }
};

struct TileColumns {
  uint32_t first, last;
};

// True when the tile row has an active tile in these columns.
GAUSSLITE_INLINE bool row_is_active(const Workspace& ws, uint32_t tile_y, TileColumns columns) {
  return ws.active.any(columns.first, columns.last, tile_y, tile_y);
}

// Gradient rows are handed out in blocks, so that the shared counter is touched rarely. Row 0 is nobody's.
GAUSSLITE_INLINE uint32_t take_gradient_rows(Workspace& ws, ThreadScratch& mine, uint32_t rows) {
  if (mine.last_row - mine.next_row < rows) {
    const uint32_t block = std::max<uint32_t>(kSegment, rows);
    mine.next_row = ws.gradient_rows_used.fetch_add(block, std::memory_order_relaxed);
    mine.last_row = mine.next_row + block;
  }
  const uint32_t first = mine.next_row;
  mine.next_row += rows;
  return first;
}

class Segment {
 public:
  GAUSSLITE_INLINE Segment(Workspace& ws, ThreadScratch& mine, uint32_t first_slot)
      : ws_(ws), mine_(mine), slot_(first_slot) {}

  GAUSSLITE_INLINE uint32_t slot() const { return slot_; }

  // Packs lane `lane` of a group, or skips it when all of its tiles are inactive.
  GAUSSLITE_INLINE void add(const Splat& splat, const BoxLanes& box, int lane, uint32_t id, bool elongated) {
    const uint32_t x0 = uint32_t(box.x0[lane]), x1 = uint32_t(box.x1[lane]), y0 = uint32_t(box.y0[lane]),
                   y1 = uint32_t(box.y1[lane]);
    uint32_t first = y0 / kBlocksAcross, last = y1 / kBlocksAcross;
    const TileColumns columns{x0 / kBlocksAcross, x1 / kBlocksAcross};
    if (ws_.active_tiles != nullptr) {
      while (first <= last && !row_is_active(ws_, first, columns)) ++first;
      if (first > last) return;
      while (!row_is_active(ws_, last, columns)) --last;
    }
    const uint32_t rows = last - first + 1;
    const uint32_t gradient_row = take_gradient_rows(ws_, mine_, rows);
    Splat& out = ws_.splats[slot_];
    out = splat;
    // One store for the four.
    const uint64_t blocks = uint64_t(x0 | x1 << 16) | uint64_t(y0 | y1 << 16) << 32;
    std::memcpy(&out.block_x0, &blocks, sizeof blocks);
    out.gradient_row = gradient_row - first;
    out.elongated = elongated;
    ws_.visible[slot_] = {id, gradient_row, rows};
    add_keys(__builtin_bit_cast(uint32_t, splat.depth), first, last, columns);
    ++slot_;
  }

 private:
  // One or two rows are the rule. The second key is written always and counted only when it is one: no branch to
  // mispredict.
  GAUSSLITE_INLINE void add_keys(uint32_t depth, uint32_t first, uint32_t last, TileColumns columns) {
    if (ws_.active_tiles == nullptr) {
      add_key(depth, first, true);
      add_key(depth, first + 1, last > first);
      for (uint32_t y = first + 2; y <= last; ++y) add_key(depth, y, true);
    } else {
      for (uint32_t y = first; y <= last; ++y) add_key(depth, y, row_is_active(ws_, y, columns));
    }
  }

  GAUSSLITE_INLINE void add_key(uint32_t depth, uint32_t tile_y, bool counts) {
    KeyList& strip = mine_.strips[size_t(tile_y)];
    strip.keys[strip.count] = {depth, slot_};
    strip.count += counts;
  }

  Workspace& ws_;
  ThreadScratch& mine_;
  uint32_t slot_;
};

// Projects the `lanes` rows that `ids` names.
GAUSSLITE_INLINE void project_group(const Workspace& ws, const Sight& sight, const uint32_t* ids, int lanes,
                                    Segment& segment) {
  Pack16 row[16];
  for (int j = 0; j < 16; ++j) row[j] = load(ws.rows + size_t(kRowWidth) * ids[std::min(j, lanes - 1)]);
  transpose(row);
  const Mask16 candidates = sight.may_touch(row, largest_log_scale(row)) & first_lanes(lanes);
  if (!any(candidates)) return;

  Projection p;
  project16(row, ws.camera, p);
  const Box box(p, ws.camera);
  uint32_t visible = bits(candidates & box.visible & is_sound(row, p));
  if (visible == 0) return;

  const uint32_t elongated = bits(box.elongated);
  const BoxLanes lanes_of_box(box);
  Pack16 out[16] = {p.mean_x,
                    p.mean_y,
                    p.conic_xx * (0.5f * kLog2E),
                    p.conic_xy * kLog2E,
                    p.conic_yy * (0.5f * kLog2E),
                    p.log2_opacity,
                    row[kRgb],
                    row[kRgb + 1],
                    row[kRgb + 2],
                    p.z,
                    p.cov_xy / p.cov_xx,
                    p.cov_xy / p.cov_yy,
                    Pack16(0.0f),
                    Pack16(0.0f),
                    Pack16(0.0f),
                    Pack16(0.0f)};
  transpose(out);
  alignas(64) Splat splats[16];
  for (int j = 0; j < 16; ++j) store(reinterpret_cast<float*>(&splats[j]), out[j]);
  for (; visible != 0; visible &= visible - 1) {
    const int lane = __builtin_ctz(visible);
    segment.add(splats[lane], lanes_of_box, lane, ids[lane], elongated >> lane & 1u);
  }
}

}  // namespace

void project(Workspace& ws, int thread) {
  ThreadScratch& mine = ws.scratch[size_t(thread)];
  const Sight sight(ws);
  uint32_t found[kSegment + 16];
  mine.next_row = mine.last_row = 0;
  // The list after the last row takes second keys that do not count.
  const int lists = ws.tiles_y + 1;
  for (int y = 0; y < lists; ++y) mine.strips[size_t(y)].count = 0;
  for (uint32_t s; (s = ws.segment_ticket.fetch_add(1, std::memory_order_relaxed)) < ws.segments;) {
    const uint32_t begin = s * kSegment, end = std::min(ws.count, begin + kSegment);
    ws.segment_thread[s] = uint32_t(thread);
    KeySpan* spans = &ws.segment_keys[size_t(s) * size_t(ws.tiles_y)];
    for (int y = 0; y < lists; ++y) {
      KeyList& strip = mine.strips[size_t(y)];
      strip.keys.reserve(strip.count + kSegment + 1, strip.count);
      if (y < ws.tiles_y) spans[y].begin = strip.count;
    }
    const uint32_t* ids = ws.ids != nullptr ? ws.ids + begin : found;
    const uint32_t count = ws.ids != nullptr ? end - begin : find_candidates(ws, sight, begin, end, found);
    Segment segment(ws, mine, begin);
    for (uint32_t i = 0; i < count; i += 16) {
      for (uint32_t j = i + 16; j < std::min(i + 32, count); ++j) prefetch(ws.rows + size_t(kRowWidth) * ids[j]);
      project_group(ws, sight, ids + i, int(std::min(16u, count - i)), segment);
    }
    ws.segment_visible[s] = segment.slot() - begin;
    for (int y = 0; y < ws.tiles_y; ++y) spans[y].end = mine.strips[size_t(y)].count;
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
