// SPDX-License-Identifier: Apache-2.0
// The last blur of the SSIM loss, down the image, for one tile: from the squares of loss_ssim.cpp to the gradient by
// the image colours.
#pragma once

#include "ssim_window.h"
#include "stages.h"
#include "target_pixels.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen rows of sixteen pixels for each channel.
struct TileColours {
  alignas(64) float value[3][kSquare];
};

// Sets the gradient beyond the edge of the image, which windows also reach, to zero.
GAUSSLITE_INLINE void clear_beyond_edge(const Camera& camera, int tile_x, int tile_y, float* colours) {
  const int columns = camera.width - tile_x * kTile, rows = camera.height - tile_y * kTile;
  if (columns >= kTile && rows >= kTile) return;
  for (int i = 0; i < 3 * kSquare; ++i) {
    if (i % kTile >= columns || i / kTile % kTile >= rows) colours[i] = 0.0f;
  }
}

// The gradient of one channel of a tile: `image` and `target` are its pixels, `upper` and `lower` the three maps of the
// squares that it overlaps.
GAUSSLITE_INLINE void ssim_gradient(const float* image, const TargetTile& target, int channel, const float* upper,
                                    const float* lower, float* out) {
  const auto blurred = [&](int map, auto set) {
    blur([&](int i) { return row_between(upper + map * kSquare, lower + map * kSquare, i); }, set);
  };
  blurred(0, [&](int i, Pack16 by_x) { store(out + i * kTile, by_x); });
  blurred(1, [&](int i, Pack16 by_xx) {
    const Pack16 x = load(image + i * kTile);
    store(out + i * kTile, fma(x + x, by_xx, load(out + i * kTile)));
  });
  blurred(2, [&](int i, Pack16 by_xy) {
    store(out + i * kTile, fma(colour_row(target, channel, i), by_xy, load(out + i * kTile)));
  });
}

// Returns false, without output, if no window with a weight reaches the tile.
GAUSSLITE_INLINE bool ssim_gradient(const Workspace& ws, const Targets& targets, const ReplayedTileRow& replayed, int x,
                                    TileColours& out) {
  const size_t tile = size_t(replayed.tile_row) * size_t(ws.tiles_x) + size_t(x);
  const bool above = targets.reach[tile] != kUnreached;
  const bool below = targets.reach[tile + size_t(ws.tiles_x)] != kUnreached;
  if (!above && !below) return false;
  for (int channel = 0; channel < 3; ++channel) {
    const size_t at = ssim_square(x, channel, 0);
    ssim_gradient(replayed.replay.image.data() + image_tile(x) + size_t(channel) * kSquare, targets.tiles[tile],
                  channel, above ? replayed.upper_squares + at : kZeroSquares,
                  below ? replayed.lower_squares + at : kZeroSquares, out.value[channel]);
  }
  clear_beyond_edge(ws.camera, x, replayed.tile_row, out.value[0]);
  return true;
}

}  // namespace gausslite::GAUSSLITE_ISA
