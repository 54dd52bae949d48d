// SPDX-License-Identifier: Apache-2.0
// Renders the tiles of a tile row into Workspace::image, for Rasterizer::forward. The backward pass reuses their lists.
#include <algorithm>

#include "block_forward.h"
#include "stage_functions.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

void store_pixels(Workspace& ws, const TilePosition& tile, int b, const BlockState& state) {
  float* out = ws.image.data() + tile.block_offset(ws, b);
  store_block(out, ws.padded_width, state.r);
  store_block(out + ws.plane_pixels, ws.padded_width, state.g);
  store_block(out + 2 * ws.plane_pixels, ws.padded_width, state.b);
  store_block(out + 3 * ws.plane_pixels, ws.padded_width, state.depth);
  store_block(out + 4 * ws.plane_pixels, ws.padded_width, state.transmittance);
}

void render_tile(Workspace& ws, TileList& list, const TilePosition& tile) {
  Splat records[kChunk];
  BlockLists lists;
  BlockState state[kBlocksPerTile];
  std::fill_n(list.used, kBlocksPerTile, 0);
  uint32_t finished = 0;
  for (uint32_t first = 0; first < list.count && finished != 0xFFFF; first += kChunk) {
    load_chunk(ws, list, first, int(std::min<uint32_t>(kChunk, list.count - first)), records, lists);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      if (finished >> b & 1u) continue;
      float* no_alphas = nullptr;
      const int composited = composite<false>(records, lists.entry[b], lists.count[b], tile.pixel_x(b), tile.pixel_y(b),
                                              state[b], no_alphas);
      list.used[b] += uint32_t(composited);
      if (state[b].finished()) finished |= 1u << b;
    }
  }
  for (int b = 0; b < kBlocksPerTile; ++b) store_pixels(ws, tile, b, state[b]);
}

}  // namespace

void render_tile_row(Workspace& ws, int tile_row, int thread) {
  int count = 0;
  const DepthKey* keys = sort_tile_row(ws, tile_row, thread, count);
  bin_tile_row(ws, tile_row, keys, count, &ws.tiles[size_t(tile_row) * size_t(ws.tiles_x)]);
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = size_t(tile_row) * size_t(ws.tiles_x) + size_t(x);
    const TilePosition tile(ws, x, tile_row);
    if (ws.needed_blocks[t] == 0) {
      for (int b = 0; b < kBlocksPerTile; ++b) store_pixels(ws, tile, b, BlockState{});
    } else {
      render_tile(ws, ws.tiles[t], tile);
      for (const uint32_t used : ws.tiles[t].used) ws.scratch[size_t(thread)].block_evaluations += used;
    }
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
