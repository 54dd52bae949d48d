// SPDX-License-Identifier: Apache-2.0
// Stage 3: sorted splats to the tiles of a strip, each with a mask of the 4x4 blocks that it really touches. Culling to
// blocks rather than to tiles is the largest gain of all: an average splat touches 4 of a tile's 16 blocks.
#include <algorithm>
#include <cstring>

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// A splat and the column of a tile that its bounding box meets. They are noted first and tested then, neither with a
// branch to mispredict: which tiles a splat meets, and with which blocks, cannot be foretold.
struct Touch {
  uint32_t slot, x;
};

constexpr int kTouches = 256;  // are tested at a time

alignas(64) constexpr float kBlockX[16] = {.5f, 4.5f, 8.5f, 12.5f, .5f, 4.5f, 8.5f, 12.5f,
                                           .5f, 4.5f, 8.5f, 12.5f, .5f, 4.5f, 8.5f, 12.5f};
alignas(64) constexpr float kBlockY[16] = {.5f,  .5f,  .5f,  .5f,  4.5f,  4.5f,  4.5f,  4.5f,
                                           8.5f, 8.5f, 8.5f, 8.5f, 12.5f, 12.5f, 12.5f, 12.5f};

// Which of a tile's sixteen blocks the ellipse alpha >= 1/255 meets, all at once. The quadric is convex, so its minimum
// over the rectangle of a block's pixel centres is at the mean when that is inside, and else on one of the two sides
// that face the mean. (dx, dy) is the rectangle's point nearest to the mean, axis by axis; on the facing vertical side
// the minimum is at slope_y dx, clamped to the side, and likewise on the horizontal one.
GAUSSLITE_INLINE uint32_t touched_blocks(const Splat& s, float tile_x, float tile_y) {
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

// Appends the splats to the lists of the tiles where they touch a wanted block.
GAUSSLITE_INLINE void list_touches(const Workspace& ws, int strip, const Touch* touches, int n, const uint16_t* wanted,
                                   TileList* tiles) {
  for (int x = 0; x < ws.tiles_x; ++x) {
    tiles[x].slots.reserve(tiles[x].count + kTouches + 1 + kChunk, tiles[x].count);
    tiles[x].blocks.reserve(tiles[x].count + kTouches + 1 + kChunk, tiles[x].count);
  }
  for (int i = 0; i < n; ++i) {
    const auto [slot, x] = touches[i];
    const uint32_t blocks = wanted[x] & touched_blocks(ws.splats[slot], float(x * kTile), float(strip * kTile));
    // Written always, kept only when a block is touched.
    TileList& tile = tiles[x];
    tile.slots[tile.count] = slot;
    tile.blocks[tile.count] = uint16_t(blocks);
    tile.count += blocks != 0;
  }
}

}  // namespace

void bin_strip(const Workspace& ws, int strip, const DepthKey* keys, int count, TileList* tiles) {
  const uint16_t* wanted = &ws.wanted_blocks[size_t(strip) * size_t(ws.tiles_x)];
  for (int x = 0; x < ws.tiles_x; ++x) tiles[x].count = 0;
  Touch touches[kTouches + 2];
  int n = 0;
  for (int i = 0; i < count; ++i) {
    prefetch(&ws.splats[keys[i + kPrefetchAhead].slot]);
    const uint32_t slot = keys[i].slot;
    const uint32_t x0 = uint32_t(ws.splats[slot].tile_x0), x1 = uint32_t(ws.splats[slot].tile_x1);
    // Two columns at a time, because one or two are the rule.
    for (uint32_t x = x0; x <= x1; x += 2) {
      touches[n] = {slot, x};
      n += wanted[x] != 0;
      touches[n] = {slot, x + 1};
      n += (x < x1) & (wanted[x + 1] != 0);
      if (n >= kTouches) {
        list_touches(ws, strip, touches, n, wanted, tiles);
        n = 0;
      }
    }
  }
  list_touches(ws, strip, touches, n, wanted, tiles);
  // The tile stages prefetch a chunk ahead: slot 0 is as good as any.
  for (int x = 0; x < ws.tiles_x; ++x) {
    tiles[x].slots.reserve(tiles[x].count + kChunk, tiles[x].count);
    std::memset(&tiles[x].slots[tiles[x].count], 0, kChunk * sizeof(uint32_t));
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
