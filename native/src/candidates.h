// SPDX-License-Identifier: Apache-2.0
// Which rows may be in sight. Most rows of a map are not, and fewer still where a part of the image is drawn: finding
// them must cost next to nothing.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "projection.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

GAUSSLITE_INLINE Pack16 largest_log_scale(const Pack16* row) {
  return max(row[kLogScale], max(row[kLogScale + 1], row[kLogScale + 2]));
}

// The half-spaces of the frustum through the active part of the image, widened for a splat's extent. At most 3.33
// standard deviations of a splat are above 1/255; the clamped tangent makes its projected scale at most 1.3 times
// sqrt(1 + tan^2) / z, where tan is that of the farthest image corner.
class Frustum {
 public:
  explicit Frustum(const Workspace& ws) : camera_(ws.camera) {
    const Camera& c = camera_;
    left_ = (float(ws.active.x0) - c.cx) / c.fx;
    right_ = (float(ws.active.x1) - c.cx) / c.fx;
    top_ = (float(ws.active.y0) - c.cy) / c.fy;
    bottom_ = (float(ws.active.y1) - c.cy) / c.fy;
    reach_x_ = reach(c.width, c.cx, c.fx);
    reach_y_ = reach(c.height, c.cy, c.fy);
    pixel_ = 2.0f / std::min(c.fx, c.fy);
  }

  GAUSSLITE_INLINE Mask16 may_touch(const Pack16* mean, Pack16 largest_log_scale) const {
    return holds(Cone(*this, mean, largest_log_scale));
  }

  // Which lanes may touch an active tile; the frustum reaches round all of them and what lies between.
  GAUSSLITE_INLINE uint32_t may_touch_active(const Workspace& ws, const Pack16* mean, Pack16 largest_log_scale) const {
    const Cone cone(*this, mean, largest_log_scale);
    uint32_t left = bits(holds(cone)), out = 0;
    if (left == 0 || ws.active_tiles == nullptr) return left;
    const Pack16 inverse_z = Pack16(1.0f) / cone.z;
    alignas(64) int32_t x0[16], x1[16], y0[16], y1[16];
    store_int(x0, tile((cone.x - cone.reach_x) * inverse_z, camera_.fx, camera_.cx, ws.tiles_x));
    store_int(x1, tile((cone.x + cone.reach_x) * inverse_z, camera_.fx, camera_.cx, ws.tiles_x));
    store_int(y0, tile((cone.y - cone.reach_y) * inverse_z, camera_.fy, camera_.cy, ws.tiles_y));
    store_int(y1, tile((cone.y + cone.reach_y) * inverse_z, camera_.fy, camera_.cy, ws.tiles_y));
    for (; left != 0; left &= left - 1) {
      const int j = __builtin_ctz(left);
      const bool touches = ws.count_active(uint32_t(x0[j]), uint32_t(x1[j]), uint32_t(y0[j]), uint32_t(y1[j])) > 0;
      out |= uint32_t(touches) << j;
    }
    return out;
  }

 private:
  // Sixteen splats in the camera frame, and how far they may reach to either side at their depth.
  struct Cone {
    Pack16 x, y, z, reach_x, reach_y;

    GAUSSLITE_INLINE Cone(const Frustum& frustum, const Pack16* mean, Pack16 largest_log_scale) {
      to_camera_frame(mean, frustum.camera_, x, y, z);
      const Pack16 radius = fma(exp2_fast(largest_log_scale * kLog2E), Pack16(3.4f), z * frustum.pixel_);
      reach_x = radius * frustum.reach_x_;
      reach_y = radius * frustum.reach_y_;
    }
  };

  GAUSSLITE_INLINE Mask16 holds(const Cone& c) const {
    return (c.z >= Pack16(kNearM)) & (c.x - c.z * right_ <= c.reach_x) & (c.z * left_ - c.x <= c.reach_x) &
           (c.y - c.z * bottom_ <= c.reach_y) & (c.z * top_ - c.y <= c.reach_y);
  }

  // The tile column or row that a tangent is in, or the nearest one of the image.
  GAUSSLITE_INLINE static Pack16 tile(Pack16 tangent, float focal, float centre, int tiles) {
    const Pack16 at = fma(tangent, Pack16(focal / kTile), Pack16(centre / kTile));
    return floor(min(max(at, Pack16(0.0f)), Pack16(float(tiles - 1))));
  }

  static float reach(int pixels, float centre, float focal) {
    const float half = 0.5f * float(pixels), tangent = (half + std::fabs(centre - half)) / focal;
    return 1.5f * std::sqrt(1.0f + tangent * tangent);
  }

  const Camera& camera_;
  float left_, right_, top_, bottom_, reach_x_, reach_y_, pixel_;
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

// Of rows [begin, end), the ids of those that may touch an active tile. A test of its own costs less than
// projecting a row, and the rows that are left fill their groups. The last rows, too few for a group, all count.
GAUSSLITE_INLINE uint32_t find_candidates(Workspace& ws, const Frustum& frustum, uint32_t begin, uint32_t end,
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
      candidates = frustum.may_touch_active(ws, bounds, bounds[3]);
      if (ws.keeps_bounds && !ws.knows_bounds) store_bounds(&ws.bounds[i], bounds);
    }
    for (uint32_t j = 0; j < 16; ++j) {
      ids[count] = i + j;
      count += candidates >> j & 1u;
    }
  }
  return count;
}

}  // namespace gausslite::GAUSSLITE_ISA
