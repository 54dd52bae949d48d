// SPDX-License-Identifier: Apache-2.0
// Blocks of a tile to and from the image planes.
#pragma once

#include "block_forward.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

GAUSSLITE_INLINE void store_pixels(Workspace& ws, const TilePosition& tile, int b, const BlockState& state) {
  float* out = ws.image.data() + tile.block(ws, b);
  store_block(out, ws.padded_width, state.r);
  store_block(out + ws.plane, ws.padded_width, state.g);
  store_block(out + 2 * ws.plane, ws.padded_width, state.b);
  store_block(out + 3 * ws.plane, ws.padded_width, state.depth);
  store_block(out + 4 * ws.plane, ws.padded_width, state.transmittance);
}

// `planes`: Workspace::image or image_gradient.
GAUSSLITE_INLINE void load_pixels(const Workspace& ws, const float* planes, const TilePosition& tile, int b,
                                  Pack16 (&out)[5]) {
  for (int k = 0; k < 5; ++k) out[k] = load_block(planes + k * ws.plane + tile.block(ws, b), ws.padded_width);
}

}  // namespace gausslite::GAUSSLITE_ISA
