// SPDX-License-Identifier: Apache-2.0
// Converts bytes of a training image to colours in [0, 1], sixteen pixels at a time.
#pragma once

#include "simd/pack.h"
#include "stages.h"

namespace gausslite::GAUSSLITE_ISA {

inline constexpr ImageTile kBlackTile{};

// Bytes / 255, correctly rounded for all 256 values: 1 / 255 in two parts.
GAUSSLITE_INLINE Pack16 colours_of(Pack16 bytes) {
  constexpr float kHigh = float(1.0 / 255.0), kLow = float(1.0 / 255.0 - double(kHigh));
  return fma(bytes, Pack16(kHigh), bytes * kLow);
}

GAUSSLITE_INLINE Pack16 colour_row(const ImageTile& tile, int channel, int row) {
  return colours_of(load_bytes(tile.rgb[channel] + row * kTileSide));
}

// `corner`: offset of the 4x4 block in the tile's sixteen rows of sixteen pixels.
GAUSSLITE_INLINE Pack16 colour_block(const ImageTile& tile, int channel, int corner) {
  return colours_of(load_byte_block(tile.rgb[channel] + corner, kTileSide));
}

}  // namespace gausslite::GAUSSLITE_ISA
