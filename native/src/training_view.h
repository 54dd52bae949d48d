// SPDX-License-Identifier: Apache-2.0
// A training image in tiles, padded to whole tiles, with pixel weights per tile. It is prepared once and used in many
// steps. The mapper's views take turns, so that each step loads its view from memory. Therefore the format is compact.
#pragma once

#include <cstdint>

#include "memory.h"
#include "stages.h"

namespace gausslite {

class TrainingView {
 public:
  // rgb: height x width x 3 bytes; depth_m, pixel_weights: height x width; pixel_weights may be null (1 everywhere).
  TrainingView(int width, int height, const uint8_t* rgb, const float* depth_m, const float* pixel_weights);

  int width() const { return width_; }
  int height() const { return height_; }
  TrainingImage image(bool masked) const;
  double weight_sum(bool masked) const { return weights(masked).sum; }
  // Mean weight of the image's pixels.
  double mean_weight(bool masked) const { return weights(masked).sum / image_weights_.sum; }

 private:
  // Weights of the pixels, and what follows from them. All tiles of zeros share one entry, as do all tiles of ones.
  struct Weights {
    double sum = 0.0;
    Buffer<float> values;  // entries of 16x16 weights
    Buffer<uint32_t> array_of_tile;
    Buffer<uint16_t> weighted_blocks, reached_blocks;
    Buffer<uint8_t> square_status;
  };
  // The part of a tile inside the image.
  struct Extent {
    int x, y, columns, rows;
  };
  Extent extent(size_t tile) const;
  void copy_tile(size_t tile, const uint8_t* rgb, const float* depth_m);
  // pixel_weights: height x width; null: 1 everywhere in the image.
  void assign_weights(Weights& weights, const float* pixel_weights) const;
  void mark_reached_blocks(Weights& weights) const;
  void mark_ssim_squares(Weights& weights) const;
  size_t tile_count() const { return size_t(tiles_y_) * size_t(tiles_x_); }
  size_t square_count() const { return size_t(tiles_y_ + 1) * size_t(tiles_x_); }
  size_t tile_of(int x, int y) const { return size_t(y / kTileSide) * size_t(tiles_x_) + size_t(x / kTileSide); }
  const Weights& weights(bool masked) const { return masked && masked_ ? mask_weights_ : image_weights_; }

  int width_, height_, tiles_x_, tiles_y_;
  bool masked_;
  Buffer<ImageTile> tiles_;
  Weights image_weights_;  // 1 everywhere in the image
  Weights mask_weights_;   // the given weights
};

}  // namespace gausslite
