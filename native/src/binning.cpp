// SPDX-License-Identifier: Apache-2.0
// Assigns the sorted splats of a tile row to its tiles, each with a mask of the 4x4 blocks that its ellipse overlaps.
// Culling by block, not by tile, has the largest effect on run time: an average splat touches 4 of the 16 blocks of a
// tile.
#include <algorithm>
#include <cstring>

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// A pair of a splat and a tile column of its bounding box. The pairs are first collected and then tested, both without
// branches: the number of tiles and blocks of a splat is unpredictable.
struct SplatColumn {
  uint32_t slot, x;
};

constexpr int kMaxPairs = 256;  // batch size of the test

alignas(64) constexpr float kBlockX[16] = {.5f, 4.5f, 8.5f, 12.5f, .5f, 4.5f, 8.5f, 12.5f,
                                           .5f, 4.5f, 8.5f, 12.5f, .5f, 4.5f, 8.5f, 12.5f};
alignas(64) constexpr float kBlockY[16] = {.5f,  .5f,  .5f,  .5f,  4.5f,  4.5f,  4.5f,  4.5f,
                                           8.5f, 8.5f, 8.5f, 8.5f, 12.5f, 12.5f, 12.5f, 12.5f};

// Returns the mask of the tile's sixteen blocks that overlap the ellipse alpha >= 1/255. The quadric is convex. Its
// minimum over the rectangle of a block's pixel centres is at the mean if that is inside, else on one of the two sides
// that face the mean. (dx, dy) is the point of the rectangle nearest to the mean, axis by axis. On the facing vertical
// side the minimum is at slope_y dx, clamped to the side; on the horizontal side likewise.
GAUSSLITE_INLINE uint32_t overlapped_blocks(const Splat& s, float tile_x, float tile_y) {
  const Pack16 zero(0.0f);
  const Pack16 left = load(kBlockX) + (tile_x - s.mean_x), top = load(kBlockY) + (tile_y - s.mean_y);
  const Pack16 right = left + 3.0f, bottom = top + 3.0f;
  const Pack16 dx = min(max(left, zero), right), dy = min(max(top, zero), bottom);
  const Pack16 xx(s.quad_xx), xy(s.quad_xy), yy(s.quad_yy);
  const Pack16 y_on_side = min(max(dx * s.slope_y, top), bottom), x_on_side = min(max(dy * s.slope_x, left), right);
  const Pack16 vertical = fma(fma(xx, dx, xy * y_on_side), dx, yy * y_on_side * y_on_side);
  const Pack16 horizontal = fma(fma(xx, x_on_side, xy * dy), x_on_side, yy * dy * dy);
  return bits(min(vertical, horizontal) <= Pack16(s.log2_opacity - kLog2MinAlpha));
}

// Appends the splats to the lists of the tiles where they touch a needed block (Workspace::needed_blocks).
GAUSSLITE_INLINE void list_overlaps(const Workspace& ws, int tile_row, const SplatColumn* pairs, int n,
                                   const uint16_t* needed, TileList* tiles) {
  for (int x = 0; x < ws.tiles_x; ++x) {
    tiles[x].slots.ensure_capacity(tiles[x].count + kMaxPairs + 1 + kChunk, tiles[x].count);
    tiles[x].blocks.ensure_capacity(tiles[x].count + kMaxPairs + 1 + kChunk, tiles[x].count);
  }
  for (int i = 0; i < n; ++i) {
    const auto [slot, x] = pairs[i];
    const uint32_t blocks =
        needed[x] & overlapped_blocks(ws.splats[slot], float(x * kTileSide), float(tile_row * kTileSide));
    // Each splat is written, but counted only if it touches a needed block: no branch to mispredict.
    TileList& tile = tiles[x];
    tile.slots[tile.count] = slot;
    tile.blocks[tile.count] = uint16_t(blocks);
    tile.count += blocks != 0;
  }
}

}  // namespace

void bin_tile_row(const Workspace& ws, int tile_row, const DepthKey* keys, int count, TileList* tiles) {
  const uint16_t* needed = &ws.needed_blocks[size_t(tile_row) * size_t(ws.tiles_x)];
  for (int x = 0; x < ws.tiles_x; ++x) tiles[x].count = 0;
  SplatColumn pairs[kMaxPairs + 2];
  int n = 0;
  for (int i = 0; i < count; ++i) {
    prefetch(&ws.splats[keys[i + kPrefetchAhead].slot]);
    const uint32_t slot = keys[i].slot;
    const uint32_t x0 = uint32_t(ws.splats[slot].tile_x0), x1 = uint32_t(ws.splats[slot].tile_x1);
    // Two columns at a time: most splats touch one or two.
    for (uint32_t x = x0; x <= x1; x += 2) {
      pairs[n] = {slot, x};
      n += needed[x] != 0;
      pairs[n] = {slot, x + 1};
      n += (x < x1) & (needed[x + 1] != 0);
      if (n >= kMaxPairs) {
        list_overlaps(ws, tile_row, pairs, n, needed, tiles);
        n = 0;
      }
    }
  }
  list_overlaps(ws, tile_row, pairs, n, needed, tiles);
  // The tile stages prefetch one chunk ahead: pad the list with slot 0.
  for (int x = 0; x < ws.tiles_x; ++x) {
    tiles[x].slots.ensure_capacity(tiles[x].count + kChunk, tiles[x].count);
    std::memset(&tiles[x].slots[tiles[x].count], 0, kChunk * sizeof(uint32_t));
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
