// SPDX-License-Identifier: Apache-2.0
#include "training_view.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace gausslite {

namespace {

// An SSIM window extends 5 px from its centre: it reaches at most the second block next to the centre's block.
constexpr int kReachInBlocks = 2;
// Entries of Weights::values for all tiles with weights of 0, and for all tiles with weights of 1.
constexpr uint32_t kZerosArray = 0, kOnesArray = 1;

uint16_t block_bit(int x, int y) { return uint16_t(1u << (y % kBlocksPerSide * kBlocksPerSide + x % kBlocksPerSide)); }

uint16_t blocks_with_weight(const float* tile) {
  uint16_t blocks = 0;
  for (int i = 0; i < kTilePixels; ++i) {
    if (tile[i] != 0.0f) blocks |= block_bit(i % kTileSide / kBlockSide, i / kTileSide / kBlockSide);
  }
  return blocks;
}

// Returns an 8x8 grid of blocks (bit 8 row + column): the tile's blocks in its middle, dilated by kReachInBlocks.
uint64_t dilated(uint16_t blocks) {
  uint64_t grid = 0;
  for (int y = 0; y < kBlocksPerSide; ++y) {
    grid |= uint64_t(blocks >> (kBlocksPerSide * y) & 0xF) << (8 * (y + kReachInBlocks) + kReachInBlocks);
  }
  grid |= grid << 1 | grid << 2 | grid >> 1 | grid >> 2;
  return grid | grid << 8 | grid << 16 | grid >> 8 | grid >> 16;
}

int tiles(int pixels) { return (pixels + kTileSide - 1) / kTileSide; }

}  // namespace

TrainingView::TrainingView(int width, int height, const uint8_t* rgb, const float* depth_m, const float* pixel_weights)
    : width_(width),
      height_(height),
      tiles_x_(tiles(width)),
      tiles_y_(tiles(height)),
      masked_(pixel_weights != nullptr) {
  tiles_.ensure_exact_capacity(tile_count());
  for (size_t t = 0; t < tile_count(); ++t) copy_tile(t, rgb, depth_m);
  assign_weights(image_weights_, nullptr);
  if (masked_) assign_weights(mask_weights_, pixel_weights);
}

TrainingView::Extent TrainingView::extent(size_t tile) const {
  const int x = int(tile % size_t(tiles_x_)) * kTileSide, y = int(tile / size_t(tiles_x_)) * kTileSide;
  return {x, y, std::min(kTileSide, width_ - x), std::min(kTileSide, height_ - y)};
}

void TrainingView::copy_tile(size_t tile, const uint8_t* rgb, const float* depth_m) {
  const Extent part = extent(tile);
  ImageTile& out = tiles_[tile];
  for (int y = 0; y < part.rows; ++y) {
    const int64_t from = int64_t(part.y + y) * width_ + part.x;
    for (int k = 0; k < 3; ++k) {
      for (int x = 0; x < part.columns; ++x) out.rgb[k][y * kTileSide + x] = rgb[3 * (from + x) + k];
    }
    for (int x = 0; x < part.columns; ++x) {
      // Depths that are not positive and finite mean "no return" and are not compared.
      const float depth = depth_m[from + x];
      out.depth_m[y * kTileSide + x] = std::isfinite(depth) && depth > 0.0f ? depth : 0.0f;
    }
  }
}

void TrainingView::assign_weights(Weights& weights, const float* pixel_weights) const {
  weights.array_of_tile.ensure_exact_capacity(tile_count());
  weights.weighted_blocks.ensure_exact_capacity(tile_count());
  weights.values.ensure_capacity(2 * kTilePixels);
  std::fill_n(&weights.values[kOnesArray * kTilePixels], kTilePixels, 1.0f);
  uint32_t used = 2;
  for (size_t t = 0; t < tile_count(); ++t) {
    const Extent part = extent(t);
    float tile[kTilePixels] = {};
    for (int y = 0; y < part.rows; ++y) {
      float* row = tile + y * kTileSide;
      if (pixel_weights != nullptr) {
        std::copy_n(pixel_weights + int64_t(part.y + y) * width_ + part.x, part.columns, row);
      } else {
        std::fill_n(row, part.columns, 1.0f);
      }
    }
    bool zeros = true, ones = true;
    for (const float w : tile) {
      zeros &= w == 0.0f;
      ones &= w == 1.0f;
    }
    weights.array_of_tile[t] = zeros ? kZerosArray : ones ? kOnesArray : used;
    weights.weighted_blocks[t] = zeros ? uint16_t(0) : ones ? uint16_t(0xFFFF) : blocks_with_weight(tile);
    weights.sum += zeros ? 0.0 : ones ? double(kTilePixels) : std::accumulate(tile, tile + kTilePixels, 0.0);
    if (zeros || ones) continue;
    weights.values.ensure_capacity((size_t(used) + 1) * kTilePixels, size_t(used) * kTilePixels);
    std::copy_n(tile, kTilePixels, &weights.values[size_t(used++) * kTilePixels]);
  }
  mark_reached_blocks(weights);
  mark_ssim_squares(weights);
}

// Marks all blocks that SSIM windows around a weighted block may reach, and these blocks themselves.
void TrainingView::mark_reached_blocks(Weights& weights) const {
  weights.reached_blocks.ensure_exact_capacity(tile_count());
  const int blocks_x = (width_ + kBlockSide - 1) / kBlockSide, blocks_y = (height_ + kBlockSide - 1) / kBlockSide;
  for (size_t t = 0; t < tile_count(); ++t) {
    if (weights.weighted_blocks[t] == 0) continue;
    const Extent part = extent(t);
    const int first_x = part.x / kBlockSide - kReachInBlocks, first_y = part.y / kBlockSide - kReachInBlocks;
    for (uint64_t marked = dilated(weights.weighted_blocks[t]); marked != 0; marked &= marked - 1) {
      const int bit = __builtin_ctzll(marked), x = first_x + bit % 8, y = first_y + bit / 8;
      if (x >= 0 && x < blocks_x && y >= 0 && y < blocks_y)
        weights.reached_blocks[tile_of(x * kBlockSide, y * kBlockSide)] |= block_bit(x, y);
    }
  }
}

// Sets the status of the SSIM squares (workspace.h). The upper half of a tile in tile row k is in square row k, the
// lower half in square row k + 1. Windows of a square reach only the squares next to it in its row.
void TrainingView::mark_ssim_squares(Weights& weights) const {
  constexpr uint16_t kUpperHalf = 0x00FF, kLowerHalf = 0xFF00;
  weights.square_status.ensure_exact_capacity(square_count());
  const size_t across = size_t(tiles_x_);
  for (size_t t = 0; t < tile_count(); ++t) {
    if ((weights.weighted_blocks[t] & kUpperHalf) != 0) weights.square_status[t] = kWeighted;
    if ((weights.weighted_blocks[t] & kLowerHalf) != 0) weights.square_status[t + across] = kWeighted;
  }
  for (size_t i = 0; i < square_count(); ++i) {
    if (weights.square_status[i] != kWeighted) continue;
    const size_t x = i % across;
    if (x > 0) weights.square_status[i - 1] = std::max(weights.square_status[i - 1], uint8_t(kWindowInput));
    if (x + 1 < across) weights.square_status[i + 1] = std::max(weights.square_status[i + 1], uint8_t(kWindowInput));
  }
}

TrainingImage TrainingView::image(bool masked) const {
  const Weights& w = weights(masked);
  return {tiles_.data(),           w.values.data(),       w.array_of_tile.data(), w.weighted_blocks.data(),
          w.reached_blocks.data(), w.square_status.data()};
}

}  // namespace gausslite
