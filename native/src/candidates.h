// SPDX-License-Identifier: Apache-2.0
// Culling: finds the parameter rows whose splats may be visible in the active tiles, called candidates. Most rows of a
// map are not, so the test must be cheap.
#pragma once

#include <algorithm>
#include <cstring>

#include "projection.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

GAUSSLITE_INLINE Pack16 largest_log_scale(const Pack16* row) {
  return max(row[kLogScale], max(row[kLogScale + 1], row[kLogScale + 2]));
}

// Writes first + j for each bit j of `lanes`, in order, and returns the number; overwrites up to sixteen elements.
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

// The same with the integers in `numbers` instead of first + j.
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

// Bounds of a splat in the image, from its mean and largest scale s alone. An isotropic splat of scale s has the image
// covariance s^2 J J^T + d I (projection.h), which bounds that of the real splat in each direction. Alpha exceeds 1/255
// within at most 3.33 standard deviations. kMotion: whether the camera moves.
template <bool kMotion>
class CullingBounds {
 public:
  explicit CullingBounds(const Workspace& ws)
      : camera_(ws.camera),
        limit_u_(kTangentLimitFactor * 0.5f * float(camera_.width) / camera_.fx),
        limit_v_(kTangentLimitFactor * 0.5f * float(camera_.height) / camera_.fy) {
    const bool everywhere = ws.active_tiles == nullptr;
    const auto [x0, x1, y0, y1] = everywhere ? ActiveTiles::Box{0, ws.tiles_x, 0, ws.tiles_y} : ws.active.box();
    left_ = float(x0 * kTileSide);
    right_ = float(x1 * kTileSide);
    top_ = float(y0 * kTileSide);
    bottom_ = float(y1 * kTileSide);
  }

  // Lanes that may touch the bounding box of the active tiles.
  GAUSSLITE_INLINE Mask16 may_touch(const Pack16* mean, Pack16 largest_log_scale) const {
    return overlaps(Extent(*this, mean, largest_log_scale));
  }

  // Appends to `ids` those of the rows first ... first + 15 that may touch that box. Appends to `boxes`, unless null,
  // the tile box of each one, as tile * ActiveTiles::kSmallBoxSizes + size. Returns their number.
  GAUSSLITE_INLINE uint32_t list_in_box(const Workspace& ws, const Pack16* mean, Pack16 largest_log_scale,
                                        uint32_t first, uint32_t* ids, uint32_t* boxes) const {
    const Extent extent(*this, mean, largest_log_scale);
    const uint32_t inside = bits(overlaps(extent));
    if (inside == 0) return 0;
    if (boxes != nullptr) {
      const Pack16 x0 = tile(extent.x - extent.reach_x, ws.tiles_x), y0 = tile(extent.y - extent.reach_y, ws.tiles_y);
      const Pack16 across = tile(extent.x + extent.reach_x, ws.tiles_x) - x0;
      const Pack16 down = tile(extent.y + extent.reach_y, ws.tiles_y) - y0;
      const Pack16 max_span(float(ActiveTiles::kSmallBox - 1)), sizes { float(ActiveTiles::kSmallBoxSizes) };
      const Mask16 too_large = (across > max_span) | (down > max_span);
      const Pack16 tile_index =
          select(too_large, Pack16(float(ws.active.sentinel_tile())), fma(y0, Pack16(float(ws.tiles_x)), x0));
      // Size 0 at the sentinel tile: a float cannot represent more for the largest images.
      const Pack16 size = select(too_large, Pack16(0.0f), fma(down, Pack16(float(ActiveTiles::kSmallBox)), across));
      list_lanes(boxes, fma(tile_index, sizes, size), inside);
    }
    return list_lanes(ids, first, inside);
  }

 private:
  // Sixteen splats: smallest depth, mean and reach in pixels.
  struct Extent {
    Pack16 z, x, y, reach_x, reach_y;

    GAUSSLITE_INLINE Extent(const CullingBounds& culling, const Pack16* mean, Pack16 largest_log_scale) {
      const Camera& c = culling.camera_;
      to_camera_frame(mean, c, x, y, z);
      if constexpr (kMotion) {
        set_moving(culling, largest_log_scale);
        return;
      }
      const Pack16 inverse_z = reciprocal(z), u = x * inverse_z, v = y * inverse_z;
      const Pack16 angle = exp(largest_log_scale) * inverse_z;
      x = fma(u, Pack16(c.fx), Pack16(c.cx));
      y = fma(v, Pack16(c.fy), Pack16(c.cy));
      reach_x = reach(angle * c.fx, min(abs(u), Pack16(culling.limit_u_)), c.dilation_px2);
      reach_y = reach(angle * c.fy, min(abs(v), Pack16(culling.limit_v_)), c.dilation_px2);
    }

    // The same at the times of exposure, with shear and blur (projection.h).
    GAUSSLITE_INLINE void set_moving(const CullingBounds& culling, Pack16 largest_log_scale) {
      const Camera& c = culling.camera_;
      const Pack16 depth = z;
      const RowExposure exposure(c, x, y, z, reciprocal(z));
      exposure.move(x, y, z);
      Pack16 velocity[3];
      point_velocity(c.motion, x, y, z, velocity);
      const Pack16 inverse_z = reciprocal(z), u = x * inverse_z, v = y * inverse_z;
      const Pack16 limit_u(culling.limit_u_), limit_v(culling.limit_v_);
      const Pack16 u_clamped = min(max(u, -limit_u), limit_u), v_clamped = min(max(v, -limit_v), limit_v);
      const Pack16 speed_x = abs(fnma(u_clamped, velocity[2], velocity[0]) * inverse_z * c.fx);
      const Pack16 speed_y = fnma(v_clamped, velocity[2], velocity[1]) * inverse_z * c.fy;
      const Pack16 angle = exp(largest_log_scale) * inverse_z;
      const Pack16 sharp_x = deviation(angle * c.fx, u_clamped), sharp_y = deviation(angle * c.fy, v_clamped);
      const Pack16 sheared_x = fma(abs(exposure.time_per_row) * speed_x, sharp_y, sharp_x);
      const Pack16 sheared_y = abs(fma(exposure.time_per_row, speed_y, Pack16(1.0f))) * sharp_y;
      const float blur_s = exposure_deviation_s(c.motion);
      reach_x = reach_of(sheared_x * sheared_x + speed_x * speed_x * (blur_s * blur_s) + c.dilation_px2);
      reach_y = reach_of(sheared_y * sheared_y + speed_y * speed_y * (blur_s * blur_s) + c.dilation_px2);
      x = fma(u, Pack16(c.fx), Pack16(c.cx));
      y = fma(v, Pack16(c.fy), Pack16(c.cy));
      z = min(z, depth);
    }

    // Standard deviation without dilation; `size` is the scale in pixels at the image centre.
    GAUSSLITE_INLINE static Pack16 deviation(Pack16 size, Pack16 tangent) {
      const Pack16 square = max(size * size * fma(tangent, tangent, Pack16(1.0f)), Pack16(1e-30f));
      return square * rough_inverse_sqrt(square);
    }

    // `size`: the scale in pixels at the image centre. 3.35 exceeds 3.33 to allow for rounding.
    GAUSSLITE_INLINE static Pack16 reach(Pack16 size, Pack16 tangent, float dilation_px2) {
      return reach_of(fma(size * size, fma(tangent, tangent, Pack16(1.0f)), Pack16(dilation_px2)));
    }

    GAUSSLITE_INLINE static Pack16 reach_of(Pack16 variance) { return variance * rough_inverse_sqrt(variance) * 3.35f; }
  };

  GAUSSLITE_INLINE Mask16 overlaps(const Extent& e) const {
    return (e.z >= Pack16(kNearPlaneM)) & (e.x - e.reach_x <= Pack16(right_)) & (e.x + e.reach_x >= Pack16(left_)) &
           (e.y - e.reach_y <= Pack16(bottom_)) & (e.y + e.reach_y >= Pack16(top_));
  }

  // The tile column or row of a pixel, clamped to the image.
  GAUSSLITE_INLINE static Pack16 tile(Pack16 pixel, int tiles) {
    return floor(min(max(pixel * (1.0f / kTileSide), Pack16(0.0f)), Pack16(float(tiles - 1))));
  }

  const Camera& camera_;
  float limit_u_, limit_v_, left_, right_, top_, bottom_;
};

// Stores the bounds of a changed row.
GAUSSLITE_INLINE void store_row_bounds(Workspace& ws, uint32_t id, const float* row) {
  GroupBounds& group = ws.bounds[id / 16];
  for (int k = 0; k < 3; ++k) group.mean[k][id % 16] = row[kMean + k];
  group.log_scale[id % 16] = std::max(row[kLogScale], std::max(row[kLogScale + 1], row[kLogScale + 2]));
}

// Loads the stored bounds of sixteen rows.
GAUSSLITE_INLINE void load_bounds(const GroupBounds& from, Pack16 (&bounds)[4]) {
  for (int k = 0; k < 3; ++k) bounds[k] = load(from.mean[k]);
  bounds[3] = load(from.log_scale);
}

GAUSSLITE_INLINE void store_bounds(GroupBounds& to, const Pack16 (&bounds)[4]) {
  for (int k = 0; k < 3; ++k) store(to.mean[k], bounds[k]);
  store(to.log_scale, bounds[3]);
}

// Computes the bounds of sixteen rows.
GAUSSLITE_INLINE void bounds_from_rows(const float* rows, Pack16 (&bounds)[4]) {
  Pack16 row[8];
  for (int k = 0; k < 4; ++k) {
    row[k] = load_block(rows + kRowWidth * k, 4 * kRowWidth);
    row[4 + k] = load_block(rows + kRowWidth * k + 4, 4 * kRowWidth);
  }
  transpose_within_quads(row[0], row[1], row[2], row[3]);
  transpose_within_quads(row[4], row[5], row[6], row[7]);
  for (int k = 0; k < 3; ++k) bounds[k] = row[kMean + k];
  bounds[3] = largest_log_scale(row);
}

// Finds the rows of [begin, end) that may touch an active tile. This test costs less than a projection, and it fills
// the groups of sixteen for the projection. The last rows, too few for a group, are all candidates.
template <bool kMotion>
GAUSSLITE_INLINE uint32_t find_candidates(Workspace& ws, const CullingBounds<kMotion>& culling, uint32_t begin,
                                          uint32_t end, uint32_t* ids) {
  const bool by_tile = ws.active_tiles != nullptr && !ws.active.fill_box();
  uint32_t boxes[kSegmentRows + 16], in_box = 0, count = 0, i = begin;
  for (; i + 16 <= end; i += 16) {
    Pack16 bounds[4];
    if (ws.has_bounds) {
      load_bounds(ws.bounds[i / 16], bounds);
    } else {
      bounds_from_rows(ws.rows + size_t(kRowWidth) * i, bounds);
      if (ws.stores_bounds) store_bounds(ws.bounds[i / 16], bounds);
    }
    in_box += culling.list_in_box(ws, bounds, bounds[3], i, ids + in_box, by_tile ? boxes + in_box : nullptr);
  }
  if (!by_tile) {
    count = in_box;
  } else {
    // Each id is written, but counted only if its box has an active tile: no branch to mispredict.
    for (uint32_t k = 0; k < in_box; ++k) {
      ids[count] = ids[k];
      count +=
          ws.active.any_in_small_box(boxes[k] / ActiveTiles::kSmallBoxSizes, boxes[k] % ActiveTiles::kSmallBoxSizes);
    }
  }
  for (; i < end; ++i) ids[count++] = i;
  return count;
}

}  // namespace gausslite::GAUSSLITE_ISA
