// SPDX-License-Identifier: Apache-2.0
// A training image, prepared once: planar, padded to whole tiles, with the blurred target that SSIM needs.
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
    Buffer<uint16_t> spans;
    Buffer<uint8_t> tiles;
  };
  void locate(Weights& weights) const;
  const Weights& weights(bool masked) const { return masked && masked_ ? mask_ : inside_; }

  int width_, height_, padded_width_;
  int64_t plane_;
  bool masked_;
  Buffer<float>
      planes_;  // r g b, depth, inside (1 in the image, 0 in the padding), mask, three means, three mean squares
  Weights inside_, mask_;
};

}  // namespace gausslite
