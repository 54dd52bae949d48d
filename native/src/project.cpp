// SPDX-License-Identifier: Apache-2.0
// Stage 1: parameter rows to visible splats, and their depth keys to the tile rows that they touch.
#include <algorithm>
#include <cmath>

#include "projection.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// The half-spaces of the view frustum, widened for a splat's extent. At most 3.33 standard deviations of a splat are
// above 1/255; the clamped tangent makes its projected scale at most 1.3 times sqrt(1 + tan^2) / z.
struct Frustum {
  float tan_x, tan_y, reach_x, reach_y, pixel;

  explicit Frustum(const Camera& c) {
    const float half_width = 0.5f * float(c.width), half_height = 0.5f * float(c.height);
    tan_x = (half_width + std::fabs(c.cx - half_width)) / c.fx;
    tan_y = (half_height + std::fabs(c.cy - half_height)) / c.fy;
    reach_x = 1.5f * std::sqrt(1.0f + tan_x * tan_x);
    reach_y = 1.5f * std::sqrt(1.0f + tan_y * tan_y);
    pixel = 2.0f / std::min(c.fx, c.fy);
  }

  GAUSSLITE_INLINE Mask16 may_touch(const Pack16* row, const Camera& camera) const {
    Pack16 x, y, z;
    to_camera_frame(row, camera, x, y, z);
    const Pack16 largest = max(row[kLogScale], max(row[kLogScale + 1], row[kLogScale + 2]));
    const Pack16 radius = fma(exp2_fast(largest * kLog2E), Pack16(3.4f), z * pixel);
    return (z >= Pack16(kNearM)) & (abs(x) - z * tan_x <= radius * reach_x) & (abs(y) - z * tan_y <= radius * reach_y);
  }
};

// The pixels whose centres are in the bounding box of alpha >= 1/255, both ends included, and their 4x4 blocks.
struct Box {
  Pack16 x0, x1, y0, y1, block_x0, block_x1, block_y0, block_y1;
  Mask16 visible, elongated;

  GAUSSLITE_INLINE Box(const Projection& p, const Camera& camera) {
    const Pack16 above = p.log2_opacity - kLog2MinAlpha, zero(0.0f);
    const Pack16 square = max(above * (2.0f * kLn2), zero);
    const Pack16 reach_x = sqrt(square * p.cov_xx), reach_y = sqrt(square * p.cov_yy);
    x0 = max(ceil(p.mean_x - reach_x - 0.5f), zero);
    y0 = max(ceil(p.mean_y - reach_y - 0.5f), zero);
    x1 = min(floor(p.mean_x + reach_x - 0.5f), Pack16(float(camera.width - 1)));
    y1 = min(floor(p.mean_y + reach_y - 0.5f), Pack16(float(camera.height - 1)));
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

// The box in integers, lane by lane.
struct BoxLanes {
  alignas(64) int32_t x0[16], x1[16], y0[16], y1[16];

  GAUSSLITE_INLINE explicit BoxLanes(const Box& box) {
    store_int(x0, box.x0);
    store_int(x1, box.x1);
    store_int(y0, box.y0);
    store_int(y1, box.y1);
  }
};

// True when the tile row has an active tile in these columns.
GAUSSLITE_INLINE bool row_is_active(const Workspace& ws, int tile_y, int tile_x0, int tile_x1) {
  const uint16_t* before = &ws.active_before[size_t(tile_y) * (ws.tiles_x + 1)];
  return before[tile_x1 + 1] > before[tile_x0];
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
    const int tile_x0 = box.x0[lane] / kTile, tile_x1 = box.x1[lane] / kTile;
    int first = box.y0[lane] / kTile, last = box.y1[lane] / kTile;
    if (ws_.active_tiles != nullptr) {
      while (first <= last && !row_is_active(ws_, first, tile_x0, tile_x1)) ++first;
      while (first < last && !row_is_active(ws_, last, tile_x0, tile_x1)) --last;
      if (first > last) return;
    }
    const uint32_t rows = uint32_t(last - first + 1);
    const uint32_t gradient_row = take_gradient_rows(ws_, mine_, rows);
    Splat& out = ws_.splats[slot_];
    out = splat;
    out.block_x0 = uint16_t(box.x0[lane] / kBlock);
    out.block_x1 = uint16_t(box.x1[lane] / kBlock);
    out.block_y0 = uint16_t(box.y0[lane] / kBlock);
    out.block_y1 = uint16_t(box.y1[lane] / kBlock);
    out.gradient_row = gradient_row - uint32_t(first);
    out.elongated = elongated;
    ws_.visible[slot_] = {id, gradient_row, rows};

    const uint32_t depth = __builtin_bit_cast(uint32_t, splat.depth);
    for (int y = first; y <= last; ++y) {
      if (ws_.active_tiles != nullptr && !row_is_active(ws_, y, tile_x0, tile_x1)) continue;
      KeyList& strip = mine_.strips[size_t(y)];
      strip.keys[strip.count++] = {depth, slot_};
    }
    ++slot_;
  }

 private:
  Workspace& ws_;
  ThreadScratch& mine_;
  uint32_t slot_;
};

GAUSSLITE_INLINE void project_group(const Workspace& ws, const Frustum& frustum, uint32_t begin, int lanes,
                                    Segment& segment) {
  Pack16 row[16];
  uint32_t ids[16];
  for (int j = 0; j < 16; ++j) {
    const uint32_t entry = begin + uint32_t(std::min(j, lanes - 1));
    ids[j] = ws.ids != nullptr ? ws.ids[entry] : entry;
    row[j] = load(ws.rows + size_t(kRowWidth) * ids[j]);
  }
  transpose(row);
  const Mask16 candidates = frustum.may_touch(row, ws.camera) & first_lanes(lanes);
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
  const Frustum frustum(ws.camera);
  mine.next_row = mine.last_row = 0;
  for (int y = 0; y < ws.tiles_y; ++y) mine.strips[size_t(y)].count = 0;
  for (uint32_t s = uint32_t(thread); s < ws.segments; s += uint32_t(ws.threads)) {
    const uint32_t begin = s * kSegment, end = std::min(ws.count, begin + kSegment);
    for (int y = 0; y < ws.tiles_y; ++y) {
      KeyList& strip = mine.strips[size_t(y)];
      strip.keys.reserve(strip.count + kSegment, strip.count);
    }
    Segment segment(ws, mine, begin);
    for (uint32_t i = begin; i < end; i += 16) project_group(ws, frustum, i, int(std::min(16u, end - i)), segment);
    ws.segment_visible[s] = segment.slot() - begin;
    uint32_t* ends = &ws.segment_keys[size_t(s) * size_t(ws.tiles_y)];
    for (int y = 0; y < ws.tiles_y; ++y) ends[y] = mine.strips[size_t(y)].count;
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
