// SPDX-License-Identifier: Apache-2.0
// Lookup tables of the active tiles, the tiles that a step renders. They test a box of tiles in a few instructions:
// culling does this for each parameter row of a map.
#pragma once

#include <cstdint>

#include "memory.h"

namespace gausslite {

// The functions that the stages call are always inlined, like Buffer's members.
class ActiveTiles {
 public:
  // Builds the tables. `active`: one flag per tile, in `down` rows of `across` flags.
  void assign(const uint8_t* active, int across, int down);

  // Bounding box of the active tiles: columns x0 ... x1 - 1, rows y0 ... y1 - 1. Without active tiles x1 < x0.
  struct Box {
    int x0, x1, y0, y1;
  };
  __attribute__((always_inline)) const Box& box() const { return box_; }
  // Whether all tiles of the bounding box are active.
  __attribute__((always_inline)) bool fill_box() const { return fill_box_; }

  // Whether any tile in these columns and rows, ends included, is active.
  __attribute__((always_inline)) bool any(uint32_t x0, uint32_t x1, uint32_t y0, uint32_t y1) const {
    const uint32_t across = x1 - x0, down = y1 - y0;
    if ((across | down) < kSmallBox) return any_in_small_box(y0 * uint32_t(across_) + x0, kSmallBox * down + across);
    const uint32_t *above = &prefix_counts_[(across_ + 1) * y0],
                   *within = &prefix_counts_[(across_ + 1) * (size_t(y1) + 1)];
    return within[x1 + 1] - within[x0] != above[x1 + 1] - above[x0];
  }

  // The same for boxes of up to kSmallBox x kSmallBox tiles, without a branch. `tile` is the index of the first tile,
  // y0 * across + x0; `size` is kSmallBox * (y1 - y0) + x1 - x0.
  static constexpr uint32_t kSmallBox = 4;  // a power of two; few splats span more tiles
  static constexpr uint32_t kSmallBoxSizes = kSmallBox * kSmallBox;
  __attribute__((always_inline)) bool any_in_small_box(uint32_t tile, uint32_t size) const {
    return small_box_masks_[tile] >> size & 1u;
  }
  // A tile index for boxes that are too large for any_in_small_box: it returns true for each size.
  __attribute__((always_inline)) uint32_t sentinel_tile() const { return sentinel_tile_; }

 private:
  void build_prefix_counts(const uint8_t* active, size_t down);
  void build_small_box_masks(const uint8_t* active, size_t down);

  size_t across_ = 0;
  uint32_t sentinel_tile_ = 0;
  bool fill_box_ = false;
  Box box_{};
  // [tile]: bit kSmallBox h + w is set if the box from this tile to h rows below and w columns right has an active
  // tile.
  Buffer<uint16_t> small_box_masks_;
  // [tile row + 1][tile column + 1]: number of active tiles above and to the left.
  Buffer<uint32_t> prefix_counts_;
};

}  // namespace gausslite
