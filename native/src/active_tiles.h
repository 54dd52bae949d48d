// SPDX-License-Identifier: Apache-2.0
// Lookup tables of the active tiles: any box of tiles is tested in a few instructions, because each row of the map
// needs it.
#pragma once

#include <cstdint>

#include "memory.h"

namespace gausslite {

// The functions that the stages call are always inlined, like Buffer's members.
class ActiveTiles {
 public:
  // Builds the tables. `active`: down rows of across flags.
  void assign(const uint8_t* active, int across, int down);

  // Bounding box of the active tiles, ends excluded; without active tiles its ends precede its beginnings.
  struct Box {
    int x0, x1, y0, y1;
  };
  __attribute__((always_inline)) const Box& box() const { return box_; }
  // Whether all tiles of the bounding box are active.
  __attribute__((always_inline)) bool fill_box() const { return fill_box_; }

  // Whether any tile in these columns and rows, ends included, is active.
  __attribute__((always_inline)) bool any(uint32_t x0, uint32_t x1, uint32_t y0, uint32_t y1) const {
    const uint32_t across = x1 - x0, down = y1 - y0;
    if ((across | down) < kNear) return any_near(y0 * uint32_t(across_) + x0, kNear * down + across);
    const uint32_t *above = &before_[(across_ + 1) * y0], *within = &before_[(across_ + 1) * (size_t(y1) + 1)];
    return within[x1 + 1] - within[x0] != above[x1 + 1] - above[x0];
  }

  // The same for boxes of up to kNear x kNear tiles, without a branch. `tile` is the index of the first tile, y0 *
  // across + x0; `size` is kNear * (y1 - y0) + x1 - x0.
  static constexpr uint32_t kNear = 4, kSizes = kNear * kNear;  // a power of two; few splats span more tiles
  __attribute__((always_inline)) bool any_near(uint32_t tile, uint32_t size) const { return near_[tile] >> size & 1u; }
  // A tile index for boxes that are too large for any_near: it returns true for each size.
  __attribute__((always_inline)) uint32_t sentinel_tile() const { return sentinel_tile_; }

 private:
  void count(const uint8_t* active, size_t down);
  void build_near_masks(const uint8_t* active, size_t down);

  size_t across_ = 0;
  uint32_t sentinel_tile_ = 0;
  bool fill_box_ = false;
  Box box_{};
  Buffer<uint16_t>
      near_;  // [tile]: bit 4 h + w is set if a tile in the box from it to h rows below and w columns right is active
  Buffer<uint32_t> before_;  // [tile row + 1][tile column + 1]: active tiles above and to the left
};

}  // namespace gausslite
