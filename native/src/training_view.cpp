// SPDX-License-Identifier: Apache-2.0
#include "training_view.h"

#include <algorithm>
#include <cmath>

namespace gausslite {

namespace {

constexpr int kBlocksPerSide = kTile / kBlock;
constexpr int kReachInBlocks = 2;  // an SSIM window reaches 5 px: from a block into the second one beside it

uint16_t block_bit(int x, int y) { return uint16_t(1u << (y % kBlocksPerSide * kBlocksPerSide + x % kBlocksPerSide)); }

int tiles(int pixels) { return (pixels + kTile - 1) / kTile; }

}  // namespace

TrainingView::TrainingView(const Stages& stages, int width, int height, const uint8_t* rgb, const float* depth_m,
                           const float* weight)
    : width_(width), height_(height), tiles_x_(tiles(width)), tiles_y_(tiles(height)), masked_(weight != nullptr) {
  tiles_.reserve_exactly(tile_count() * kTargets * kSquare);
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int64_t from = int64_t(y) * width + x;
      float* to = &tiles_[tile_of(x, y) * kTargets * kSquare + size_t(y % kTile * kTile + x % kTile)];
      for (int k = 0; k < 3; ++k) to[k * kSquare] = float(rgb[3 * from + k]) / 255.0f;
      // Whatever a sensor writes for "no return", a depth that is not a positive number is not compared.
      to[3 * kSquare] = std::isfinite(depth_m[from]) && depth_m[from] > 0.0f ? depth_m[from] : 0.0f;
    }
  }
  weigh(inside_, nullptr);
  if (masked_) weigh(mask_, weight);
  moments_.reserve_exactly(square_count() * 3 * 2 * kSquare);
  Buffer<float> scratch;
  scratch.reserve(stages.ssim_scratch_floats(tiles_x_));
  stages.prepare_ssim(tiles_.data(), tiles_x_, tiles_y_, moments_.data(), scratch.data());
}

// The squares of the SSIM loss lie half a tile higher than the tiles and have their columns one after the other.
void TrainingView::weigh(Weights& weights, const float* weight) const {
  weights.tiles.reserve_exactly(tile_count() * kSquare);
  weights.weighted_blocks.reserve(tile_count());
  weights.squares.reserve_exactly(square_count() * kSquare);
  weights.reach.reserve(square_count());
  for (int y = 0; y < height_; ++y) {
    for (int x = 0; x < width_; ++x) {
      const float w = weight != nullptr ? weight[int64_t(y) * width_ + x] : 1.0f;
      if (w == 0.0f) continue;
      const size_t tile = tile_of(x, y), square = tile_of(x, y + kTile / 2);
      weights.sum += double(w);
      weights.tiles[tile * kSquare + size_t(y % kTile * kTile + x % kTile)] = w;
      weights.weighted_blocks[tile] |= block_bit(x / kBlock, y / kBlock);
      weights.squares[square * kSquare + size_t(x % kTile * kTile + (y + kTile / 2) % kTile)] = w;
      weights.reach[square] = kWeighted;
    }
  }
  reach_out(weights);
}

// From the blocks and squares with a weight to those that its windows reach.
void TrainingView::reach_out(Weights& weights) const {
  weights.reached_blocks.reserve(tile_count());
  const int last_x = (width_ - 1) / kBlock, last_y = (height_ - 1) / kBlock;
  for (int y = 0; y <= last_y; ++y) {
    for (int x = 0; x <= last_x; ++x) {
      if ((weights.weighted_blocks[tile_of(x * kBlock, y * kBlock)] & block_bit(x, y)) == 0) continue;
      for (int v = std::max(0, y - kReachInBlocks); v <= std::min(last_y, y + kReachInBlocks); ++v) {
        for (int u = std::max(0, x - kReachInBlocks); u <= std::min(last_x, x + kReachInBlocks); ++u)
          weights.reached_blocks[tile_of(u * kBlock, v * kBlock)] |= block_bit(u, v);
      }
    }
  }
  for (size_t i = 0; i < square_count(); ++i) {
    if (weights.reach[i] != kWeighted) continue;
    const size_t x = i % size_t(tiles_x_);
    if (x > 0) weights.reach[i - 1] = std::max(weights.reach[i - 1], uint8_t(kReached));
    if (x + 1 < size_t(tiles_x_)) weights.reach[i + 1] = std::max(weights.reach[i + 1], uint8_t(kReached));
  }
}

Targets TrainingView::targets(bool masked) const {
  const Weights& w = weights(masked);
  return {tiles_.data(),
          w.tiles.data(),
          w.weighted_blocks.data(),
          w.reached_blocks.data(),
          {moments_.data(), w.squares.data(), w.reach.data()}};
}

}  // namespace gausslite
