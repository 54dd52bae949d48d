// SPDX-License-Identifier: Apache-2.0
// A training image, prepared once: in tiles, padded to whole tiles, with weights per tile. A mapper picks one of many
// views at random, so that it comes from memory in each step: the format is compact.
#pragma once

#include <cstdint>

#include "memory.h"
#include "stages.h"

namespace gausslite {

class TrainingView {
 public:
  // rgb: height x width x 3 bytes; depth_m, weight: height x width; weight may be null (1 everywhere).
  TrainingView(int width, int height, const uint8_t* rgb, const float* depth_m, const float* weight);

  int width() const { return width_; }
  int height() const { return height_; }
  Targets targets(bool masked) const;
  double weight_sum(bool masked) const { return weights(masked).sum; }
  // Mean weight of the image.
  double share(bool masked) const { return weights(masked).sum / inside_.sum; }

 private:
  // Weights of the pixels. All tiles of zeros share one entry, as do all tiles of ones.
  struct Weights {
    double sum = 0.0;
    Buffer<float> values;
    Buffer<uint32_t> entries;
    Buffer<uint16_t> weighted_blocks, reached_blocks;
    Buffer<uint8_t> reach;
  };
  // The part of a tile inside the image.
  struct Extent {
    int x, y, columns, rows;
  };
  Extent extent(size_t tile) const;
  void copy_tile(size_t tile, const uint8_t* rgb, const float* depth_m);
  // weight: height x width, or null for 1 everywhere.
  void assign_weights(Weights& weights, const float* weight) const;
  void reach_blocks(Weights& weights) const;
  void reach_squares(Weights& weights) const;
  size_t tile_count() const { return size_t(tiles_y_) * size_t(tiles_x_); }
  size_t square_count() const { return size_t(tiles_y_ + 1) * size_t(tiles_x_); }
  size_t tile_of(int x, int y) const { return size_t(y / kTile) * size_t(tiles_x_) + size_t(x / kTile); }
  const Weights& weights(bool masked) const { return masked && masked_ ? mask_ : inside_; }

  int width_, height_, tiles_x_, tiles_y_;
  bool masked_;
  Buffer<TargetTile> tiles_;
  Weights inside_, mask_;
};

}  // namespace gausslite
