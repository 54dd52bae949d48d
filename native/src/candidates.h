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

// The same with whole numbers in place of first + j.
GAUSSLITE_INLINE void list_lanes(uint32_t* out, Pack16 numbers, uint32_t lanes) {
#if defined(GAUSSLITE_USE_AVX512)
  _mm512_storeu_si512(out, _mm512_maskz_compress_epi32(__mmask16(lanes), _mm512_cvttps_epi32(numbers.v)));
#else
  alignas(64) int32_t number[16];
  store_int(number, numbers);
  uint32_t count = 0;
  for (uint32_t j = 0; j < 16; ++j) {
    out[count] = uint32_t(number[j]);
    count += lanes >> j & 1u;
  }
#endif
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

  // Appends to `ids` the rows first ... first + 15 that may touch that box; and to `boxes`, unless it is null, the
  // tiles that each of them reaches, as a place and a size of ActiveTiles. Returns how many.
  GAUSSLITE_INLINE uint32_t list_in_box(const Workspace& ws, const Pack16* mean, Pack16 largest_log_scale,
                                        uint32_t first, uint32_t* ids, uint32_t* boxes) const {
    const Extent extent(*this, mean, largest_log_scale);
    const uint32_t held = bits(holds(extent));
    if (held == 0) return 0;
    if (boxes != nullptr) {
      const Pack16 x0 = tile(extent.x - extent.reach_x, ws.tiles_x), y0 = tile(extent.y - extent.reach_y, ws.tiles_y);
      const Pack16 across = tile(extent.x + extent.reach_x, ws.tiles_x) - x0;
      const Pack16 down = tile(extent.y + extent.reach_y, ws.tiles_y) - y0;
      const Pack16 most(float(ActiveTiles::kNear - 1)), sizes(float(ActiveTiles::kSizes));
      const Mask16 far = (across > most) | (down > most);
      const Pack16 place = select(far, Pack16(float(ws.active.far_place())), fma(y0, Pack16(float(ws.tiles_x)), x0));
      // Zero at the far place: a float has no room for more behind the largest images' number of tiles.
      const Pack16 size = select(far, Pack16(0.0f), fma(down, Pack16(float(ActiveTiles::kNear)), across));
      list_lanes(boxes, fma(place, sizes, size), held);
    }
    return list_lanes(ids, first, held);
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
GAUSSLITE_INLINE void note_bounds(Workspace& ws, uint32_t id, const float* row) {
  GroupBounds& group = ws.bounds[id / 16];
  for (int k = 0; k < 3; ++k) group.mean[k][id % 16] = row[kMean + k];
  group.log_scale[id % 16] = std::max(row[kLogScale], std::max(row[kLogScale + 1], row[kLogScale + 2]));
}

// Sixteen rows' bounds, from what is known of them.
GAUSSLITE_INLINE void load_bounds(const GroupBounds& from, Pack16 (&bounds)[4]) {
  for (int k = 0; k < 3; ++k) bounds[k] = load(from.mean[k]);
  bounds[3] = load(from.log_scale);
}

GAUSSLITE_INLINE void store_bounds(GroupBounds& to, const Pack16 (&bounds)[4]) {
  for (int k = 0; k < 3; ++k) store(to.mean[k], bounds[k]);
  store(to.log_scale, bounds[3]);
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

// Of rows [begin, end), the ids of those that may touch an active tile. A test of its own costs less than
// projecting a row, and the rows that are left fill their groups. The last rows, too few for a group, all count.
GAUSSLITE_INLINE uint32_t find_candidates(Workspace& ws, const Sight& sight, uint32_t begin, uint32_t end,
                                          uint32_t* ids) {
  const bool by_tile = ws.active_tiles != nullptr && !ws.active.fill_box();
  uint32_t boxes[kSegment + 16], in_box = 0, count = 0, i = begin;
  for (; i + 16 <= end; i += 16) {
    Pack16 bounds[4];
    if (ws.knows_bounds) {
      load_bounds(ws.bounds[i / 16], bounds);
    } else {
      find_bounds(ws.rows + size_t(kRowWidth) * i, bounds);
      if (ws.keeps_bounds) store_bounds(ws.bounds[i / 16], bounds);
    }
    in_box += sight.list_in_box(ws, bounds, bounds[3], i, ids + in_box, by_tile ? boxes + in_box : nullptr);
  }
  if (!by_tile) {
    count = in_box;
  } else {
    // Written always, and only then counted or not: no branch to mispredict.
    for (uint32_t k = 0; k < in_box; ++k) {
      ids[count] = ids[k];
      count += ws.active.any_near(boxes[k] / ActiveTiles::kSizes, boxes[k] % ActiveTiles::kSizes);
    }
  }
  for (; i < end; ++i) ids[count++] = i;
  return count;
}

}  // namespace gausslite::GAUSSLITE_ISA
