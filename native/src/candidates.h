// SPDX-License-Identifier: Apache-2.0
// Which rows may be in sight. Most rows of a map are not, and fewer still where a part of the image is drawn: finding
// them must cost next to nothing.
#pragma once

#include <algorithm>
#include <cstring>

#include "projection.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

GAUSSLITE_INLINE Pack16 largest_log_scale(const Pack16* row) {
  return max(row[kLogScale], max(row[kLogScale + 1], row[kLogScale + 2]));
}

// Where in the image a splat may be, by its mean and the largest of its scales alone. With a scale s along all axes its
// image covariance is s^2 J J^T + 0.3 I, and no direction of a real splat is longer. At most 3.33 standard deviations
// of it are above 1/255.
class Sight {
 public:
  explicit Sight(const Workspace& ws)
      : camera_(ws.camera),
        limit_u_(kTangentLimit * 0.5f * float(camera_.width) / camera_.fx),
        limit_v_(kTangentLimit * 0.5f * float(camera_.height) / camera_.fy) {
    const bool everywhere = ws.active_tiles == nullptr;
    const auto [x0, x1, y0, y1] = everywhere ? ActiveTiles::Box{0, ws.tiles_x, 0, ws.tiles_y} : ws.active.box();
    left_ = float(x0 * kTile);
    right_ = float(x1 * kTile);
    top_ = float(y0 * kTile);
    bottom_ = float(y1 * kTile);
  }

  // Which lanes may touch the box round the active tiles.
  GAUSSLITE_INLINE Mask16 may_touch(const Pack16* mean, Pack16 largest_log_scale) const {
    return holds(Extent(*this, mean, largest_log_scale));
  }

  // Which lanes may touch an active tile; the box holds all of them and what lies between.
  GAUSSLITE_INLINE uint32_t may_touch_active(const Workspace& ws, const Pack16* mean, Pack16 largest_log_scale) const {
    const Extent extent(*this, mean, largest_log_scale);
    const uint32_t held = bits(holds(extent));
    if (ws.active_tiles == nullptr) return held;
    // All lanes are looked up, wanted or not: no branch to mispredict. Those that reach over many tiles just count.
    const Pack16 x0 = tile(extent.x - extent.reach_x, ws.tiles_x), y0 = tile(extent.y - extent.reach_y, ws.tiles_y);
    const Pack16 across = tile(extent.x + extent.reach_x, ws.tiles_x) - x0;
    const Pack16 down = tile(extent.y + extent.reach_y, ws.tiles_y) - y0;
    const Pack16 most(float(ActiveTiles::kNear - 1));
    alignas(64) int32_t place[16], size[16];
    store_int(place, fma(y0, Pack16(float(ws.tiles_x)), x0));
    store_int(size, fma(min(down, most), Pack16(float(ActiveTiles::kNear)), min(across, most)));
    uint32_t touching = bits((across > most) | (down > most));
    for (int j = 0; j < 16; ++j) touching |= uint32_t(ws.active.any_near(uint32_t(place[j]), uint32_t(size[j]))) << j;
    return held & touching;
  }

 private:
  // Sixteen splats: depth, mean and reach in pixels.
  struct Extent {
    Pack16 z, x, y, reach_x, reach_y;

    GAUSSLITE_INLINE Extent(const Sight& sight, const Pack16* mean, Pack16 largest_log_scale) {
      const Camera& c = sight.camera_;
      to_camera_frame(mean, c, x, y, z);
      const Pack16 inverse_z = reciprocal(z), u = x * inverse_z, v = y * inverse_z;
      const Pack16 angle = exp(largest_log_scale) * inverse_z;
      x = fma(u, Pack16(c.fx), Pack16(c.cx));
      y = fma(v, Pack16(c.fy), Pack16(c.cy));
      reach_x = reach(angle * c.fx, min(abs(u), Pack16(sight.limit_u_)));
      reach_y = reach(angle * c.fy, min(abs(v), Pack16(sight.limit_v_)));
    }

    // `size`: the scale in pixels, seen straight on. A little wider than 3.33, against rounding.
    GAUSSLITE_INLINE static Pack16 reach(Pack16 size, Pack16 tangent) {
      const Pack16 square = fma(size * size, fma(tangent, tangent, Pack16(1.0f)), Pack16(kDilationPx2));
      return square * rough_inverse_sqrt(square) * 3.35f;
    }
  };

  GAUSSLITE_INLINE Mask16 holds(const Extent& e) const {
    return (e.z >= Pack16(kNearM)) & (e.x - e.reach_x <= Pack16(right_)) & (e.x + e.reach_x >= Pack16(left_)) &
           (e.y - e.reach_y <= Pack16(bottom_)) & (e.y + e.reach_y >= Pack16(top_));
  }

  // The tile column or row that a pixel is in, or the nearest one of the image.
  GAUSSLITE_INLINE static Pack16 tile(Pack16 pixel, int tiles) {
    return floor(min(max(pixel * (1.0f / kTile), Pack16(0.0f)), Pack16(float(tiles - 1))));
  }

  const Camera& camera_;
  float limit_u_, limit_v_, left_, right_, top_, bottom_;
};

// Notes the bounds of a row that has changed.
GAUSSLITE_INLINE void note_bounds(RowBounds& bounds, const float* row) {
  std::memcpy(bounds.mean, row + kMean, sizeof bounds.mean);
  bounds.log_scale = std::max(row[kLogScale], std::max(row[kLogScale + 1], row[kLogScale + 2]));
}

// Sixteen rows' bounds, transposed, from what is known of them.
GAUSSLITE_INLINE void load_bounds(const RowBounds* from, Pack16 (&bounds)[4]) {
  for (int k = 0; k < 4; ++k) bounds[k] = load_block(from[k].mean, 16);
  transpose_quads(bounds[0], bounds[1], bounds[2], bounds[3]);
}

GAUSSLITE_INLINE void store_bounds(RowBounds* to, Pack16 (&bounds)[4]) {
  transpose_quads(bounds[0], bounds[1], bounds[2], bounds[3]);
  for (int k = 0; k < 4; ++k) store_block(to[k].mean, 16, bounds[k]);
}

// ... and from the rows themselves.
GAUSSLITE_INLINE void find_bounds(const float* rows, Pack16 (&bounds)[4]) {
  Pack16 row[8];
  for (int k = 0; k < 4; ++k) {
    row[k] = load_block(rows + kRowWidth * k, 4 * kRowWidth);
    row[4 + k] = load_block(rows + kRowWidth * k + 4, 4 * kRowWidth);
  }
  transpose_quads(row[0], row[1], row[2], row[3]);
  transpose_quads(row[4], row[5], row[6], row[7]);
  for (int k = 0; k < 3; ++k) bounds[k] = row[kMean + k];
  bounds[3] = largest_log_scale(row);
}

// Writes first + j for each bit j of `lanes`, in order, and returns how many; up to sixteen places are overwritten.
GAUSSLITE_INLINE uint32_t list_lanes(uint32_t* out, uint32_t first, uint32_t lanes) {
#if defined(GAUSSLITE_USE_AVX512)
  const __m512i numbers = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const __m512i ids = _mm512_add_epi32(numbers, _mm512_set1_epi32(int(first)));
  _mm512_storeu_si512(out, _mm512_maskz_compress_epi32(__mmask16(lanes), ids));
  return uint32_t(__builtin_popcount(lanes));
#else
  uint32_t count = 0;
  for (uint32_t j = 0; j < 16; ++j) {
    out[count] = first + j;
    count += lanes >> j & 1u;
  }
  return count;
#endif
}

// Of rows [begin, end), the ids of those that may touch an active tile. A test of its own costs less than
// projecting a row, and the rows that are left fill their groups. The last rows, too few for a group, all count.
GAUSSLITE_INLINE uint32_t find_candidates(Workspace& ws, const Sight& sight, uint32_t begin, uint32_t end,
                                          uint32_t* ids) {
  uint32_t count = 0;
  for (uint32_t i = begin; i < end; i += 16) {
    uint32_t candidates = (1u << ((end - i) % 16)) - 1u;
    if (end - i >= 16) {
      Pack16 bounds[4];
      if (ws.knows_bounds) {
        load_bounds(&ws.bounds[i], bounds);
      } else {
        find_bounds(ws.rows + size_t(kRowWidth) * i, bounds);
      }
      candidates = sight.may_touch_active(ws, bounds, bounds[3]);
      if (ws.keeps_bounds && !ws.knows_bounds) store_bounds(&ws.bounds[i], bounds);
    }
    count += list_lanes(ids + count, i, candidates);
  }
  return count;
}

}  // namespace gausslite::GAUSSLITE_ISA
