// SPDX-License-Identifier: Apache-2.0
// The last blur of the SSIM loss, down the image, for one tile: from the squares that loss_ssim.cpp left to the
// gradient by the image's colours.
#pragma once

#include "ssim_window.h"
#include "stages.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen rows of sixteen pixels for each channel.
struct TileColours {
  alignas(64) float value[3][kSquare];
};

alignas(64) inline constexpr float kNoSquare[kSquare] = {};

// Windows reach beyond the image's edge, but nothing there can change.
GAUSSLITE_INLINE void clear_beyond(TileColours& colours, int columns, int rows) {
  for (int channel = 0; channel < 3; ++channel) {
    for (int i = 0; i < kTile; ++i) {
      for (int x = i < rows ? columns : 0; x < kTile; ++x) colours.value[channel][i * kTile + x] = 0.0f;
    }
  }
}

// Returns false, and nothing in `out`, where no window around a weight reaches the tile.
GAUSSLITE_INLINE bool ssim_gradient(Workspace& ws, const Targets& targets, const TilePosition& tile, TileColours& out) {
  const size_t square = size_t(tile.y) * size_t(ws.tiles_x) + size_t(tile.x);
  const bool above = targets.ssim.reach[square] != kUnreached;
  const bool below = targets.ssim.reach[square + size_t(ws.tiles_x)] != kUnreached;
  if (!above && !below) return false;
  for (int channel = 0; channel < 3; ++channel) {
    const float* image = ws.image.data() + channel * ws.plane + tile.corner;
    const float* target = targets.rgb + channel * ws.plane + tile.corner;
    float* to = out.value[channel];
    const auto blurred = [&](int map, auto set) {
      const float* upper = above ? ws.ssim_square(tile.y, tile.x, channel, map) : kNoSquare;
      const float* lower = below ? ws.ssim_square(tile.y + 1, tile.x, channel, map) : kNoSquare;
      // The tile's first row is the middle of the upper square.
      constexpr int kFirst = kTile / 2 - kRadius;
      blur(
          [&](int i) {
            return load(i < kTile - kFirst ? upper + (i + kFirst) * kTile : lower + (i + kFirst - kTile) * kTile);
          },
          set);
    };
    blurred(0, [&](int i, Pack16 by_x) { store(to + i * kTile, by_x); });
    blurred(1, [&](int i, Pack16 by_xx) {
      const Pack16 x = load(image + i * ws.padded_width);
      store(to + i * kTile, fma(x + x, by_xx, load(to + i * kTile)));
    });
    blurred(2, [&](int i, Pack16 by_xy) {
      store(to + i * kTile, fma(load(target + i * ws.padded_width), by_xy, load(to + i * kTile)));
    });
  }
  const int columns = ws.camera.width - tile.x * kTile, rows = ws.camera.height - tile.y * kTile;
  if (columns < kTile || rows < kTile) clear_beyond(out, columns, rows);
  return true;
}

}  // namespace gausslite::GAUSSLITE_ISA
