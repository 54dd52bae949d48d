// SPDX-License-Identifier: Apache-2.0
#include "training_view.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace gausslite {

namespace {

constexpr int kReachInBlocks = 2;          // an SSIM window reaches 5 px: up to the second block next to its own
constexpr uint32_t kZeros = 0, kOnes = 1;  // shared entries of Weights::values

uint16_t block_bit(int x, int y) { return uint16_t(1u << (y % kBlocksAcross * kBlocksAcross + x % kBlocksAcross)); }

uint16_t blocks_with_weight(const float* tile) {
  uint16_t blocks = 0;
  for (int i = 0; i < kSquare; ++i) {
    if (tile[i] != 0.0f) blocks |= block_bit(i % kTile / kBlock, i / kTile / kBlock);
  }
  return blocks;
}

// Returns an 8x8 grid (bit 8 row + column) with the tile's blocks in its middle, dilated by the reach of the SSIM
// window.
uint64_t dilated(uint16_t blocks) {
  uint64_t grid = 0;
  for (int y = 0; y < kBlocksAcross; ++y) {
    grid |= uint64_t(blocks >> (kBlocksAcross * y) & 0xF) << (8 * (y + kReachInBlocks) + kReachInBlocks);
  }
  grid |= grid << 1 | grid << 2 | grid >> 1 | grid >> 2;
  return grid | grid << 8 | grid << 16 | grid >> 8 | grid >> 16;
}

int tiles(int pixels) { return (pixels + kTile - 1) / kTile; }

}  // namespace

TrainingView::TrainingView(int width, int height, const uint8_t* rgb, const float* depth_m, const float* weight)
    : width_(width), height_(height), tiles_x_(tiles(width)), tiles_y_(tiles(height)), masked_(weight != nullptr) {
  tiles_.reserve_exactly(tile_count());
  for (size_t t = 0; t < tile_count(); ++t) copy_tile(t, rgb, depth_m);
  assign_weights(inside_, nullptr);
  if (masked_) assign_weights(mask_, weight);
}

TrainingView::Extent TrainingView::extent(size_t tile) const {
  const int x = int(tile % size_t(tiles_x_)) * kTile, y = int(tile / size_t(tiles_x_)) * kTile;
  return {x, y, std::min(kTile, width_ - x), std::min(kTile, height_ - y)};
}

void TrainingView::copy_tile(size_t tile, const uint8_t* rgb, const float* depth_m) {
  const Extent part = extent(tile);
  TargetTile& out = tiles_[tile];
  for (int y = 0; y < part.rows; ++y) {
    const int64_t from = int64_t(part.y + y) * width_ + part.x;
    for (int k = 0; k < 3; ++k) {
      for (int x = 0; x < part.columns; ++x) out.rgb[k][y * kTile + x] = rgb[3 * (from + x) + k];
    }
    for (int x = 0; x < part.columns; ++x) {
      // Depths that are not positive and finite mean "no return" and are not compared.
      const float depth = depth_m[from + x];
      out.depth_m[y * kTile + x] = std::isfinite(depth) && depth > 0.0f ? depth : 0.0f;
    }
  }
}

void TrainingView::assign_weights(Weights& weights, const float* weight) const {
  weights.entries.reserve_exactly(tile_count());
  weights.weighted_blocks.reserve_exactly(tile_count());
  weights.values.reserve(2 * kSquare);
  std::fill_n(&weights.values[kOnes * kSquare], kSquare, 1.0f);
  uint32_t used = 2;
  for (size_t t = 0; t < tile_count(); ++t) {
    const Extent part = extent(t);
    float own[kSquare] = {};
    for (int y = 0; y < part.rows; ++y) {
      float* row = own + y * kTile;
      if (weight != nullptr) {
        std::copy_n(weight + int64_t(part.y + y) * width_ + part.x, part.columns, row);
      } else {
        std::fill_n(row, part.columns, 1.0f);
      }
    }
    bool zeros = true, ones = true;
    for (const float w : own) {
      zeros &= w == 0.0f;
      ones &= w == 1.0f;
    }
    weights.entries[t] = zeros ? kZeros : ones ? kOnes : used;
    weights.weighted_blocks[t] = zeros ? uint16_t(0) : ones ? uint16_t(0xFFFF) : blocks_with_weight(own);
    weights.sum += zeros ? 0.0 : ones ? double(kSquare) : std::accumulate(own, own + kSquare, 0.0);
    if (zeros || ones) continue;
    weights.values.reserve((size_t(used) + 1) * kSquare, size_t(used) * kSquare);
    std::copy_n(own, kSquare, &weights.values[size_t(used++) * kSquare]);
  }
  reach_blocks(weights);
  reach_squares(weights);
}

// Marks all blocks in reach of a block with a weight.
void TrainingView::reach_blocks(Weights& weights) const {
  weights.reached_blocks.reserve_exactly(tile_count());
  const int blocks_x = (width_ + kBlock - 1) / kBlock, blocks_y = (height_ + kBlock - 1) / kBlock;
  for (size_t t = 0; t < tile_count(); ++t) {
    if (weights.weighted_blocks[t] == 0) continue;
    const Extent part = extent(t);
    const int first_x = part.x / kBlock - kReachInBlocks, first_y = part.y / kBlock - kReachInBlocks;
    for (uint64_t left = dilated(weights.weighted_blocks[t]); left != 0; left &= left - 1) {
      const int bit = __builtin_ctzll(left), x = first_x + bit % 8, y = first_y + bit / 8;
      if (x >= 0 && x < blocks_x && y >= 0 && y < blocks_y)
        weights.reached_blocks[tile_of(x * kBlock, y * kBlock)] |= block_bit(x, y);
    }
  }
}

// Marks the squares of the SSIM loss, which lie half a tile higher than the tiles.
void TrainingView::reach_squares(Weights& weights) const {
  constexpr uint16_t kUpperHalf = 0x00FF, kLowerHalf = 0xFF00;
  weights.reach.reserve_exactly(square_count());
  const size_t across = size_t(tiles_x_);
  for (size_t t = 0; t < tile_count(); ++t) {
    if ((weights.weighted_blocks[t] & kUpperHalf) != 0) weights.reach[t] = kWeighted;
    if ((weights.weighted_blocks[t] & kLowerHalf) != 0) weights.reach[t + across] = kWeighted;
  }
  for (size_t i = 0; i < square_count(); ++i) {
    if (weights.reach[i] != kWeighted) continue;
    const size_t x = i % across;
    if (x > 0) weights.reach[i - 1] = std::max(weights.reach[i - 1], uint8_t(kReached));
    if (x + 1 < across) weights.reach[i + 1] = std::max(weights.reach[i + 1], uint8_t(kReached));
  }
}

Targets TrainingView::targets(bool masked) const {
  const Weights& w = weights(masked);
  return {tiles_.data(),           w.values.data(), w.entries.data(), w.weighted_blocks.data(),
          w.reached_blocks.data(), w.reach.data()};
}

}  // namespace gausslite
