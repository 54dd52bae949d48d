// SPDX-License-Identifier: Apache-2.0
// Where an image is drawn, when it is only in some of its tiles: told for any box of tiles in a few instructions,
// because every row of the map asks.
#pragma once

#include <cstdint>

#include "memory.h"

namespace gausslite {

// What the stages call is always inlined, as a Buffer's members are.
class ActiveTiles {
 public:
  // `active`: across x down flags.
  void look_at(const uint8_t* active, int across, int down);

  // The smallest box of tiles around the active ones, ends not included. Empty ones end before they begin.
  struct Box {
    int x0, x1, y0, y1;
  };
  __attribute__((always_inline)) const Box& box() const { return box_; }
  // Whether all tiles of it are active.
  __attribute__((always_inline)) bool fill_box() const { return fill_box_; }

  // Whether any tile in these columns and rows, ends included, is active.
  __attribute__((always_inline)) bool any(uint32_t x0, uint32_t x1, uint32_t y0, uint32_t y1) const {
    const uint32_t across = x1 - x0, down = y1 - y0;
    if ((across | down) < kNear) return any_near(y0 * uint32_t(across_) + x0, kNear * down + across);
    const uint32_t *above = &before_[(across_ + 1) * y0], *within = &before_[(across_ + 1) * (size_t(y1) + 1)];
    return within[x1 + 1] - within[x0] != above[x1 + 1] - above[x0];
  }

  // The same for boxes of up to kNear tiles a side, without a branch: `place` is y0 times the tiles across plus x0, and
  // `size` is kNear (y1 - y0) + x1 - x0.
  static constexpr uint32_t kNear = 4, kSizes = kNear * kNear;  // a power of two: few splats reach over more
  __attribute__((always_inline)) bool any_near(uint32_t place, uint32_t size) const {
    return near_[place] >> size & 1u;
  }
  // A place where any_near is true of every size, for boxes that are too large for it.
  __attribute__((always_inline)) uint32_t far_place() const { return far_place_; }

 private:
  void count(const uint8_t* active, size_t down);
  void look_near(const uint8_t* active, size_t down);

  size_t across_ = 0;
  uint32_t far_place_ = 0;
  bool fill_box_ = false;
  Box box_{};
  Buffer<uint16_t> near_;    // [tile]: bit 4 h + w says whether any is active from it to h rows down and w columns on
  Buffer<uint32_t> before_;  // [tile row + 1][tile column + 1]: active tiles above and to the left
};

}  // namespace gausslite
