// SPDX-License-Identifier: Apache-2.0
#include "training_view.h"

#include <algorithm>
#include <cmath>

namespace gausslite {

namespace {

enum Plane { kRgbPlane = 0, kDepthPlane = 3, kInsidePlane = 4, kMaskPlane = 5, kPlanes = 6 };

constexpr int kBlocksPerSide = kTile / kBlock;
constexpr int kReachInBlocks = 2;  // an SSIM window reaches 5 px: from a block into the second one beside it

uint16_t block_bit(int x, int y) { return uint16_t(1u << (y % kBlocksPerSide * kBlocksPerSide + x % kBlocksPerSide)); }

int tiles(int pixels) { return (pixels + kTile - 1) / kTile; }

}  // namespace

TrainingView::TrainingView(const Stages& stages, int width, int height, const uint8_t* rgb, const float* depth_m,
                           const float* weight)
    : width_(width),
      height_(height),
      tiles_x_(tiles(width)),
      tiles_y_(tiles(height)),
      padded_width_(tiles_x_ * kTile),
      plane_(int64_t(tiles_x_) * tiles_y_ * kSquare),
      masked_(weight != nullptr),
      inside_{kInsidePlane, 0.0, {}, {}, {}, {}},
      mask_{kMaskPlane, 0.0, {}, {}, {}, {}} {
  planes_.reserve_exactly(size_t(plane_) * kPlanes);
  float* p = planes_.data();
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int64_t from = int64_t(y) * width + x, to = int64_t(y) * padded_width_ + x;
      for (int k = 0; k < 3; ++k) p[(kRgbPlane + k) * plane_ + to] = float(rgb[3 * from + k]) / 255.0f;
      // Whatever a sensor writes for "no return", a depth that is not a positive number is not compared.
      p[kDepthPlane * plane_ + to] = std::isfinite(depth_m[from]) && depth_m[from] > 0.0f ? depth_m[from] : 0.0f;
      p[kInsidePlane * plane_ + to] = 1.0f;
      if (masked_) p[kMaskPlane * plane_ + to] = weight[from];
    }
  }
  for (Weights* weights : {&inside_, &mask_}) {
    if (weights == &mask_ && !masked_) continue;
    locate(*weights);
    cut_squares(*weights);
  }
  moments_.reserve(squares() * 3 * 2 * kSquare);
  Buffer<float> scratch;
  scratch.reserve(stages.ssim_scratch_floats(tiles_x_));
  stages.prepare_ssim(p, tiles_x_, tiles_y_, moments_.data(), scratch.data());
}

// The blocks with a weight, and those within reach of one.
void TrainingView::locate(Weights& weights) const {
  weights.weighted_blocks.reserve(size_t(tiles_x_) * size_t(tiles_y_));
  weights.reached_blocks.reserve(size_t(tiles_x_) * size_t(tiles_y_));
  const auto tile = [&](int block_x, int block_y) {
    return size_t(block_y / kBlocksPerSide * tiles_x_ + block_x / kBlocksPerSide);
  };
  for (int y = 0; y < height_; ++y) {
    const float* row = planes_.data() + weights.plane * plane_ + int64_t(y) * padded_width_;
    for (int x = 0; x < width_; ++x) {
      weights.sum += double(row[x]);
      if (row[x] != 0.0f) weights.weighted_blocks[tile(x / kBlock, y / kBlock)] |= block_bit(x / kBlock, y / kBlock);
    }
  }
  const int last_x = (width_ - 1) / kBlock, last_y = (height_ - 1) / kBlock;
  for (int y = 0; y <= last_y; ++y) {
    for (int x = 0; x <= last_x; ++x) {
      if ((weights.weighted_blocks[tile(x, y)] & block_bit(x, y)) == 0) continue;
      for (int v = std::max(0, y - kReachInBlocks); v <= std::min(last_y, y + kReachInBlocks); ++v) {
        for (int u = std::max(0, x - kReachInBlocks); u <= std::min(last_x, x + kReachInBlocks); ++u)
          weights.reached_blocks[tile(u, v)] |= block_bit(u, v);
      }
    }
  }
}

// The weights by columns of the squares of the SSIM loss, which lie half a tile higher than the tiles.
void TrainingView::cut_squares(Weights& weights) const {
  weights.squares.reserve(squares() * kSquare);
  weights.reach.reserve(squares());
  for (int y = 0; y < height_; ++y) {
    const float* row = planes_.data() + weights.plane * plane_ + int64_t(y) * padded_width_;
    const int k = (y + kTile / 2) / kTile;
    for (int x = 0; x < width_; ++x) {
      if (row[x] == 0.0f) continue;
      const size_t square = size_t(k) * size_t(tiles_x_) + size_t(x / kTile);
      weights.squares[square * kSquare + size_t(x % kTile * kTile + (y + kTile / 2) % kTile)] = row[x];
      weights.reach[square] = kWeighted;
    }
  }
  for (size_t i = 0; i < squares(); ++i) {
    if (weights.reach[i] != kWeighted) continue;
    const size_t x = i % size_t(tiles_x_);
    if (x > 0) weights.reach[i - 1] = std::max(weights.reach[i - 1], uint8_t(kReached));
    if (x + 1 < size_t(tiles_x_)) weights.reach[i + 1] = std::max(weights.reach[i + 1], uint8_t(kReached));
  }
}

Targets TrainingView::targets(bool masked) const {
  const Weights& w = weights(masked);
  const float* p = planes_.data();
  return {p,
          p + kDepthPlane * plane_,
          p + w.plane * plane_,
          w.weighted_blocks.data(),
          w.reached_blocks.data(),
          {moments_.data(), w.squares.data(), w.reach.data()}};
}

}  // namespace gausslite
