// SPDX-License-Identifier: Apache-2.0
// Backward pass of rendered tiles, for Rasterizer::backward: from the gradients of pixels to the image gradients of
// splats (row_layout.h), with the lists of the forward pass.
#include <algorithm>

#include "block_backward.h"
#include "block_forward.h"
#include "stage_functions.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

void load_pixels(const Workspace& ws, const float* planes, const TilePosition& tile, int b, Pack16 (&out)[5]) {
  for (int k = 0; k < 5; ++k)
    out[k] = load_block(planes + k * ws.plane_pixels + tile.block_offset(ws, b), ws.padded_width);
}

void backward_tile(Workspace& ws, const TileList& list, const TilePosition& tile) {
  Splat records[kChunk];
  BlockLists lists;
  ChunkSums sums;
  MomentBatch batch;
  BlockGradient gradients[kBlocksPerTile];
  uint32_t left[kBlocksPerTile], total_left = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    left[b] = list.used[b];
    total_left += left[b];
    Pack16 image[5], gradient[5];
    load_pixels(ws, ws.image.data(), tile, b, image);
    load_pixels(ws, ws.image_gradient.data(), tile, b, gradient);
    gradients[b].start(gradient, image);
  }
  for (uint32_t first = 0; first < list.count && total_left > 0; first += kChunk) {
    const int n = int(std::min<uint32_t>(kChunk, list.count - first));
    load_chunk(ws, list, first, n, records, lists);
    prefetch_rows(ws, records, n, tile);
    sums.clear(n);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const uint32_t entries = std::min<uint32_t>(lists.count[b], left[b]);
      const float* no_alphas = nullptr;
      if (entries > 0)
        backward_block<false>(records, lists.entry[b], int(entries), tile, b, gradients[b], sums, batch, no_alphas);
      left[b] -= entries;
      total_left -= entries;
    }
    batch.flush(sums.moments);
    add_to_rows(ws, records, n, tile, sums);
  }
}

}  // namespace

void backward_tile_row(Workspace& ws, int tile_row, int) {
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = size_t(tile_row) * size_t(ws.tiles_x) + size_t(x);
    if (ws.needed_blocks[t] != 0) backward_tile(ws, ws.tiles[t], TilePosition(ws, x, tile_row));
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
