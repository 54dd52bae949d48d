// SPDX-License-Identifier: Apache-2.0
// Projects parameter rows to visible splats, and adds their depth keys to the tile rows that they touch:
// Stages::project. stages.h defines the terms.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "candidates.h"
#include "projection.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// First and last tile columns (x0, x1) and tile rows (y0, y1) of a splat: those with a pixel centre in the bounding box
// of the splat's pixels with alpha >= 1/255.
struct Box {
  Pack16 x0, x1, y0, y1;
  Mask16 visible;

  GAUSSLITE_INLINE Box(const Projection& p, const Camera& camera) {
    const Pack16 above = p.log2_opacity - kLog2MinAlpha, zero(0.0f);
    const Pack16 square = max(above * (2.0f * kLn2), zero);
    const Pack16 reach_x = sqrt(square * p.cov_xx), reach_y = sqrt(square * p.cov_yy);
    const Pack16 left = max(ceil(p.mean_x - reach_x - 0.5f), zero);
    const Pack16 top = max(ceil(p.mean_y - reach_y - 0.5f), zero);
    const Pack16 right = min(floor(p.mean_x + reach_x - 0.5f), Pack16(float(camera.width - 1)));
    const Pack16 bottom = min(floor(p.mean_y + reach_y - 0.5f), Pack16(float(camera.height - 1)));
    visible = (above > zero) & (left <= right) & (top <= bottom);
    x0 = floor(left * (1.0f / kTileSide));
    x1 = floor(right * (1.0f / kTileSide));
    y0 = floor(top * (1.0f / kTileSide));
    y1 = floor(bottom * (1.0f / kTileSide));
  }

  // Returns the few lanes with a box that is too large for narrow(): more than kSmallBox tile columns or two tile rows.
  GAUSSLITE_INLINE uint32_t large() const {
    return bits(((x1 - x0 > Pack16(kMaxColumnDifference)) | (y1 - y0 > Pack16(1.0f))) & visible);
  }

  // Removes the upper or lower row of tiles from boxes that are not large, if no tile in it is active. A tile is
  // active if the view's mask has a weight above 0 in it. Returns the lanes with an active tile. All rows are looked
  // up: no branch to mispredict.
  GAUSSLITE_INLINE uint32_t narrow(const ActiveTiles& active, Pack16 tiles_x) {
    alignas(64) int32_t upper[16], lower[16], across[16];
    store_int(upper, zero_unless(visible, fma(y0, tiles_x, x0)));
    store_int(lower, zero_unless(visible, fma(y1, tiles_x, x0)));
    store_int(across, zero_unless(visible, min(x1 - x0, Pack16(kMaxColumnDifference))));
    uint32_t in_upper = 0, in_lower = 0;
    for (int j = 0; j < 16; ++j) {
      in_upper |= uint32_t(active.any_in_small_box(uint32_t(upper[j]), uint32_t(across[j]))) << j;
      in_lower |= uint32_t(active.any_in_small_box(uint32_t(lower[j]), uint32_t(across[j]))) << j;
    }
    const uint32_t small = ~large();
    const Pack16 first = y0, last = y1;
    y0 = select(mask_of(in_upper | ~small), first, last);
    y1 = select(mask_of(in_lower | ~small), last, first);
    return (in_upper | in_lower) & small;
  }

 private:
  static constexpr float kMaxColumnDifference = float(ActiveTiles::kSmallBox - 1);
};

// Returns false for rows with a NaN or infinite parameter, and for splats with an overflow in their projection.
GAUSSLITE_INLINE Mask16 is_valid(const Pack16* row, const Projection& p) {
  Pack16 total = row[0] * 0.0f;
  for (int k = 1; k < kTrainedColumns; ++k) total = fma(row[k], Pack16(0.0f), total);
  const Pack16 conic = p.conic_xx * 0.0f + p.conic_xy * 0.0f + p.conic_yy * 0.0f;
  const Pack16 shape = p.mean_x * 0.0f + p.mean_y * 0.0f + p.cov_xx * 0.0f + p.cov_yy * 0.0f;
  return (total + conic + shape == Pack16(0.0f)) & (p.conic_xx > Pack16(0.0f)) & (p.conic_yy > Pack16(0.0f));
}

// The boxes of sixteen splats as integers. The boxes of invisible splats have no meaning, but lie inside the image.
struct BoxLanes {
  alignas(64) int32_t x0[16], x1[16], y0[16], y1[16];

  GAUSSLITE_INLINE explicit BoxLanes(const Box& box) {
    store_int(x0, zero_unless(box.visible, box.x0));
    store_int(x1, zero_unless(box.visible, box.x1));
    store_int(y0, zero_unless(box.visible, box.y0));
    store_int(y1, zero_unless(box.visible, box.y1));
  }

  // Whether a lane's box has an active tile in tile row y.
  GAUSSLITE_INLINE bool active_in(const ActiveTiles& active, int lane, int y) const {
    return active.any(uint32_t(x0[lane]), uint32_t(x1[lane]), uint32_t(y), uint32_t(y));
  }

  // Removes upper and lower rows of tiles without an active tile from one large box. Returns true if a tile is active.
  GAUSSLITE_INLINE bool narrow(const ActiveTiles& active, int lane) {
    while (y0[lane] < y1[lane] && !active_in(active, lane, y0[lane])) ++y0[lane];
    while (y1[lane] > y0[lane] && !active_in(active, lane, y1[lane])) --y1[lane];
    return active_in(active, lane, y0[lane]);
  }
};

// Reserves rows of image gradients (row_layout.h) for a thread and returns the first. A thread takes them from the
// shared counter in large blocks, so that it rarely accesses the counter.
GAUSSLITE_INLINE uint32_t take_gradient_rows(Workspace& ws, ThreadScratch& thread_scratch, uint32_t rows) {
  if (thread_scratch.end_gradient_row - thread_scratch.next_gradient_row < rows) {
    const uint32_t block = std::max<uint32_t>(kSegmentRows, rows);
    thread_scratch.next_gradient_row = ws.gradient_rows_used.fetch_add(block, std::memory_order_relaxed);
    thread_scratch.end_gradient_row = thread_scratch.next_gradient_row + block;
  }
  const uint32_t first = thread_scratch.next_gradient_row;
  thread_scratch.next_gradient_row += rows;
  return first;
}

// Output of a segment: its visible splats and their keys.
class Segment {
 public:
  GAUSSLITE_INLINE Segment(Workspace& ws, ThreadScratch& thread_scratch, uint32_t first_slot)
      : ws_(ws), thread_scratch_(thread_scratch), slot_(first_slot) {}

  GAUSSLITE_INLINE uint32_t slot() const { return slot_; }

  // Adds the `visible` lanes of a group. `splats` lacks only the gradient rows. All lanes are written, and only visible
  // ones are counted: no branch to mispredict. Most boxes span one or two tile rows; the others are `tall`.
  GAUSSLITE_INLINE void add(const Pack16 (&splats)[16], const float* depth, const uint32_t* ids, const BoxLanes& boxes,
                            uint32_t visible, uint32_t tall) {
    uint32_t rows = 0;
    for (int j = 0; j < 16; ++j) rows += (visible >> j & 1u) * uint32_t(boxes.y1[j] - boxes.y0[j] + 1);
    uint32_t slot = slot_, gradient_row = take_gradient_rows(ws_, thread_scratch_, rows);
    for (int j = 0; j < 16; ++j) {
      const uint32_t counted = visible >> j & 1u;
      const int first = boxes.y0[j], last = boxes.y1[j];
      const uint32_t height = uint32_t(last - first + 1);
      Splat& splat = ws_.splats[slot];
      store(reinterpret_cast<float*>(&splat), splats[j]);
      splat.gradient_row_minus_tile_y = gradient_row - uint32_t(first);
      ws_.visible[slot] = {ids[j], gradient_row, height};
      const DepthKey key{__builtin_bit_cast(uint32_t, depth[j]), slot};
      add_key(key, first, counted);
      if (visible & tall & 1u << j) [[unlikely]] {
        for (int y = first + 1; y <= last; ++y)
          add_key(key, y, ws_.active_tiles == nullptr || boxes.active_in(ws_.active, j, y));
      } else {
        add_key(key, first + 1, counted & uint32_t(last > first));
      }
      slot += counted;
      gradient_row += counted * height;
    }
    slot_ = slot;
  }

 private:
  GAUSSLITE_INLINE void add_key(const DepthKey& key, int tile_y, uint32_t counted) {
    KeyList& tile_row = thread_scratch_.tile_rows[size_t(tile_y)];
    tile_row.keys[tile_row.count] = key;
    tile_row.count += counted;
  }

  Workspace& ws_;
  ThreadScratch& thread_scratch_;
  uint32_t slot_;
};

// Projects the first `lanes` rows of `ids`.
template <bool kMotion>
GAUSSLITE_INLINE void project_group(const Workspace& ws, const CullingBounds<kMotion>& culling, const uint32_t* ids,
                                    int lanes, Segment& segment) {
  Pack16 row[16];
  uint32_t id[16];
  for (int j = 0; j < 16; ++j) {
    id[j] = ids[std::min(j, lanes - 1)];
    row[j] = load(ws.rows + size_t(kRowWidth) * id[j]);
  }
  transpose(row);
  const Mask16 candidates = culling.may_touch(row, largest_log_scale(row)) & first_lanes(lanes);
  if (!any(candidates)) return;

  Projection p;
  project16<kMotion>(row, ws.camera, p);
  Box box(p, ws.camera);
  box.visible = box.visible & candidates & is_valid(row, p);
  uint32_t visible = bits(box.visible);
  if (visible == 0) return;

  uint32_t large = 0;
  if (ws.active_tiles != nullptr) {
    large = box.large();
    visible &= box.narrow(ws.active, Pack16(float(ws.tiles_x))) | large;
  }
  BoxLanes boxes(box);
  for (; large != 0; large &= large - 1) {
    const int j = __builtin_ctz(large);
    if (!boxes.narrow(ws.active, j)) visible &= ~(1u << j);
  }
  if (visible == 0) return;
  uint32_t tall = 0;
  for (int j = 0; j < 16; ++j) tall |= uint32_t(boxes.y1[j] - boxes.y0[j] > 1) << j;
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
                    box.x0,
                    box.x1,
                    Pack16(0.0f),
                    Pack16(0.0f)};
  transpose(out);
  alignas(64) float depth[16];
  store(depth, kMotion ? p.motion.z : p.z);  // blending keeps the order at the middle of the readout
  segment.add(out, depth, id, boxes, visible, tall);
}

template <bool kMotion>
void project_segments(Workspace& ws, int thread) {
  ThreadScratch& thread_scratch = ws.scratch[size_t(thread)];
  const CullingBounds<kMotion> culling(ws);
  uint32_t candidate_ids[kSegmentRows + 16];
  thread_scratch.next_gradient_row = thread_scratch.end_gradient_row = 0;
  // One more list than tile rows: add() writes a second key below the last tile row, without counting it.
  const int lists = ws.tiles_y + 1;
  for (int y = 0; y < lists; ++y) thread_scratch.tile_rows[size_t(y)].count = 0;
  for (uint32_t s; (s = ws.take_segment(thread)) < ws.segments;) {
    const uint32_t begin = s * kSegmentRows, end = std::min(ws.count, begin + kSegmentRows);
    ws.segment_thread[s] = uint32_t(thread);
    KeySpan* spans = &ws.segment_keys[size_t(s) * size_t(ws.tiles_y)];
    for (int y = 0; y < lists; ++y) {
      KeyList& tile_row = thread_scratch.tile_rows[size_t(y)];
      tile_row.keys.ensure_capacity(tile_row.count + kSegmentRows + 1, tile_row.count);
      if (y < ws.tiles_y) spans[y].begin = tile_row.count;
    }
    const uint32_t* ids = ws.ids != nullptr ? ws.ids + begin : candidate_ids;
    const uint32_t count = ws.ids != nullptr ? end - begin : find_candidates(ws, culling, begin, end, candidate_ids);
    Segment segment(ws, thread_scratch, begin);
    for (uint32_t i = 0; i < count; i += 16) {
      for (uint32_t j = i + 16; j < std::min(i + 32, count); ++j) prefetch(ws.rows + size_t(kRowWidth) * ids[j]);
      for (uint32_t j = 0; j < 16; ++j) prefetch_to_write(&ws.splats[segment.slot() + j]);
      project_group(ws, culling, ids + i, int(std::min(16u, count - i)), segment);
    }
    ws.segment_visible[s] = segment.slot() - begin;
    for (int y = 0; y < ws.tiles_y; ++y) spans[y].end = thread_scratch.tile_rows[size_t(y)].count;
  }
}

}  // namespace

void project(Workspace& ws, int thread) {
  ws.camera.moves ? project_segments<true>(ws, thread) : project_segments<false>(ws, thread);
}

}  // namespace gausslite::GAUSSLITE_ISA
