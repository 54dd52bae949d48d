// SPDX-License-Identifier: Apache-2.0
// The last blur of the SSIM loss, down the image, for one tile: from the derivatives in the SSIM squares
// (loss_ssim.cpp) to the gradient of the image colours.
#pragma once

#include "image_tile.h"
#include "ssim_window.h"
#include "stages.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen rows of sixteen pixels for each channel.
struct TileColours {
  alignas(64) float value[3][kTilePixels];
};

// Sets the colours (or gradients) of a tile beyond the edge of the image, which windows also reach, to zero.
GAUSSLITE_INLINE void clear_beyond_edge(const Camera& camera, int tile_x, int tile_y, float* colours) {
  const int columns = camera.width - tile_x * kTileSide, rows = camera.height - tile_y * kTileSide;
  if (columns >= kTileSide && rows >= kTileSide) return;
  for (int i = 0; i < 3 * kTilePixels; ++i) {
    if (i % kTileSide >= columns || i / kTileSide % kTileSide >= rows) colours[i] = 0.0f;
  }
}

// The gradient of one channel of a tile: `image` and `target` are its pixels, `upper` and `lower` the three maps of the
// squares that it overlaps.
GAUSSLITE_INLINE void ssim_gradient(const float* image, const ImageTile& target, int channel, const float* upper,
                                    const float* lower, float* out) {
  const auto blurred = [&](int map, auto set) {
    blur([&](int i) { return row_between(upper + map * kTilePixels, lower + map * kTilePixels, i); }, set);
  };
  blurred(0, [&](int i, Pack16 d_x) { store(out + i * kTileSide, d_x); });
  blurred(1, [&](int i, Pack16 d_xx) {
    const Pack16 x = load(image + i * kTileSide);
    store(out + i * kTileSide, fma(x + x, d_xx, load(out + i * kTileSide)));
  });
  blurred(2, [&](int i, Pack16 d_xy) {
    store(out + i * kTileSide, fma(colour_row(target, channel, i), d_xy, load(out + i * kTileSide)));
  });
}

// Computes the SSIM gradient of tile x. Returns false, without output, if no window of a weighted pixel reaches the
// tile.
GAUSSLITE_INLINE bool ssim_gradient(const Workspace& ws, const TrainingImage& training_image,
                                    const RenderedTileRow& tile_row, int x, TileColours& out) {
  const size_t tile = size_t(tile_row.index) * size_t(ws.tiles_x) + size_t(x);
  const bool above = training_image.square_status[tile] != kUnused;
  const bool below = training_image.square_status[tile + size_t(ws.tiles_x)] != kUnused;
  if (!above && !below) return false;
  for (int channel = 0; channel < 3; ++channel) {
    const size_t at = ssim_map_offset(x, channel, 0);
    ssim_gradient(tile_row.cache.image.data() + image_offset(x) + size_t(channel) * kTilePixels,
                  training_image.tiles[tile], channel, above ? tile_row.upper_squares + at : kZeroSquares,
                  below ? tile_row.lower_squares + at : kZeroSquares, out.value[channel]);
  }
  clear_beyond_edge(ws.camera, x, tile_row.index, out.value[0]);
  return true;
}

}  // namespace gausslite::GAUSSLITE_ISA
