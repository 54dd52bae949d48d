// SPDX-License-Identifier: Apache-2.0
#include "active_tiles.h"

#include <algorithm>

namespace gausslite {

void ActiveTiles::assign(const uint8_t* active, int across, int down) {
  across_ = size_t(across);
  box_ = {across, 0, down, 0};
  int tiles = 0;
  for (int y = 0; y < down; ++y) {
    for (int x = 0; x < across; ++x) {
      if (!active[y * across + x]) continue;
      ++tiles;
      box_ = {std::min(box_.x0, x), std::max(box_.x1, x + 1), std::min(box_.y0, y), y + 1};
    }
  }
  fill_box_ = tiles == (box_.x1 - box_.x0) * (box_.y1 - box_.y0);
  build_prefix_counts(active, size_t(down));
  build_small_box_masks(active, size_t(down));
}

void ActiveTiles::build_prefix_counts(const uint8_t* active, size_t down) {
  const size_t stride = across_ + 1;
  prefix_counts_.ensure_capacity(stride * (down + 1));
  std::fill_n(prefix_counts_.data(), stride, 0u);
  for (size_t y = 0; y < down; ++y) {
    const uint32_t* above = &prefix_counts_[stride * y];
    uint32_t* before = &prefix_counts_[stride * (y + 1)];
    before[0] = 0;
    uint32_t in_row = 0;
    for (size_t x = 0; x < across_; ++x) {
      in_row += active[y * across_ + x] != 0;
      before[x + 1] = above[x + 1] + in_row;
    }
  }
}

// First sets the bits of boxes of one row (the lowest four), then combines them with those of the rows below.
void ActiveTiles::build_small_box_masks(const uint8_t* active, size_t down) {
  constexpr uint32_t kRow = (1u << kSmallBox) - 1u, kEveryRow = 0x1111u;
  const size_t tiles = across_ * down;
  small_box_masks_.ensure_capacity(tiles + 1);
  sentinel_tile_ = uint32_t(tiles);
  small_box_masks_[tiles] = uint16_t(~0u);
  for (size_t t = 0; t < tiles; ++t) {
    const size_t columns = std::min<size_t>(kSmallBox, across_ - t % across_);
    uint32_t row = 0;
    for (size_t w = 0; w < columns; ++w) row |= active[t + w] ? kRow << w : 0u;
    small_box_masks_[t] = uint16_t(row & kRow);
  }
  for (size_t t = 0; t < tiles; ++t) {
    uint32_t rows = 0;
    for (size_t h = 0, below = t; h < kSmallBox && below < tiles; ++h, below += across_) {
      rows |= (small_box_masks_[below] & kRow) * kEveryRow << (kSmallBox * h);
    }
    small_box_masks_[t] = uint16_t(rows);
  }
}

}  // namespace gausslite
