// SPDX-License-Identifier: Apache-2.0
// A training image, prepared once: cut into tiles, padded to whole ones, with the blurred target that SSIM needs,
// and where its weights are.
#pragma once

#include <cstdint>

#include "memory.h"
#include "stages.h"

namespace gausslite {

class TrainingView {
 public:
  // rgb: height x width x 3 bytes; depth_m, weight: height x width; weight may be null (1 everywhere).
  TrainingView(const Stages& stages, int width, int height, const uint8_t* rgb, const float* depth_m,
               const float* weight);

  int width() const { return width_; }
  int height() const { return height_; }
  Targets targets(bool masked) const;
  double weight_sum(bool masked) const { return weights(masked).sum; }

 private:
  // One way of weighing the pixels, and where its weights are.
  struct Weights {
    double sum = 0.0;
    Buffer<float> tiles;  // Targets
    Buffer<uint16_t> weighted_blocks, reached_blocks;
    Buffer<float> squares;  // SsimTargets
    Buffer<uint8_t> reach;
  };
  // weight: height x width, or null for 1 everywhere.
  void weigh(Weights& weights, const float* weight) const;
  void reach_out(Weights& weights) const;
  size_t tile_count() const { return size_t(tiles_y_) * size_t(tiles_x_); }
  size_t square_count() const { return size_t(tiles_y_ + 1) * size_t(tiles_x_); }
  size_t tile_of(int x, int y) const { return size_t(y / kTile) * size_t(tiles_x_) + size_t(x / kTile); }
  const Weights& weights(bool masked) const { return masked && masked_ ? mask_ : inside_; }

  int width_, height_, tiles_x_, tiles_y_;
  bool masked_;
  Buffer<float> tiles_, moments_;  // Targets, SsimTargets
  Weights inside_, mask_;
};

}  // namespace gausslite
