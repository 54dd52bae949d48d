// SPDX-License-Identifier: Apache-2.0
// A training image, prepared once: planar, padded to whole tiles, with the blurred target that SSIM needs,
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
    int plane;
    double sum = 0.0;
    Buffer<uint16_t> weighted_blocks, reached_blocks;  // Targets
    Buffer<float> squares;                             // SsimTargets
    Buffer<uint8_t> reach;
  };
  void locate(Weights& weights) const;
  void cut_squares(Weights& weights) const;
  size_t squares() const { return size_t(tiles_y_ + 1) * size_t(tiles_x_); }
  const Weights& weights(bool masked) const { return masked && masked_ ? mask_ : inside_; }

  int width_, height_, tiles_x_, tiles_y_, padded_width_;
  int64_t plane_;
  bool masked_;
  Buffer<float> planes_;  // r g b, depth, inside (1 in the image, 0 in the padding), mask
  Buffer<float> moments_;
  Weights inside_, mask_;
};

}  // namespace gausslite
