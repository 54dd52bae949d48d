// SPDX-License-Identifier: Apache-2.0
// A tile's splats in chunks: their records gathered side by side, and their block masks turned into one list per block.
#pragma once

#include <cstring>

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// Turns n masks of 16 blocks into 16 lists of entries: a bit-matrix transpose.
#if defined(GAUSSLITE_USE_AVX512)
// 32 entries at a time: vptestmw picks one block's bits, vpcompressb writes the numbers of the entries that have them.
GAUSSLITE_INLINE void list_blocks(const uint16_t* blocks, int n, BlockLists& lists) {
  alignas(32) static constexpr uint8_t kNumbers[32] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                                       16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
  uint32_t count[kBlocks] = {};
  for (int i = 0; i < n; i += 32) {
    const __mmask32 present = n - i >= 32 ? 0xFFFFFFFFu : (1u << (n - i)) - 1u;
    const __m512i masks = _mm512_maskz_loadu_epi16(present, blocks + i);
    const __m256i numbers =
        _mm256_add_epi8(_mm256_load_si256(reinterpret_cast<const __m256i*>(kNumbers)), _mm256_set1_epi8(char(i)));
    for (int b = 0; b < kBlocks; ++b) {
      const __mmask32 touching = _mm512_test_epi16_mask(masks, _mm512_set1_epi16(short(1u << b)));
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(lists.entry[b] + count[b]),
                          _mm256_maskz_compress_epi8(touching, numbers));
      count[b] += uint32_t(__builtin_popcount(touching));
    }
  }
  for (int b = 0; b < kBlocks; ++b) lists.count[b] = uint16_t(count[b]);
}
#else
GAUSSLITE_INLINE void list_blocks(const uint16_t* blocks, int n, BlockLists& lists) {
  uint32_t count[kBlocks] = {};
  for (int i = 0; i < n; ++i) {
    for (uint32_t left = blocks[i]; left != 0; left &= left - 1) {
      const int b = __builtin_ctz(left);
      lists.entry[b][count[b]++] = uint8_t(i);
    }
  }
  for (int b = 0; b < kBlocks; ++b) lists.count[b] = uint16_t(count[b]);
}
#endif

// Loads entries [first, first + n) of a tile, n at most kChunk, and asks for the next chunk's splats.
GAUSSLITE_INLINE void load_chunk(const Workspace& ws, const TileList& tile, uint32_t first, int n, Splat* records,
                                 BlockLists& lists) {
  const uint32_t* slots = &tile.slots[first];
  for (int i = 0; i < n; ++i) {
    store(reinterpret_cast<float*>(&records[i]), load(reinterpret_cast<const float*>(&ws.splats[slots[i]])));
    prefetch(&ws.splats[slots[i + kChunk]]);
  }
  list_blocks(&tile.blocks[first], n, lists);
}

// Pixel centres of block b of the tile whose corner is (tile_x, tile_y).
alignas(64) constexpr float kPixelX[16] = {.5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f,
                                           .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f};
alignas(64) constexpr float kPixelY[16] = {.5f,  .5f,  .5f,  .5f,  1.5f, 1.5f, 1.5f, 1.5f,
                                           2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};

struct TilePosition {
  int x, y;        // tile column and row
  int64_t corner;  // offset of its first pixel in an image plane

  GAUSSLITE_INLINE TilePosition(const Workspace& ws, int tile_x, int tile_y)
      : x(tile_x), y(tile_y), corner(int64_t(tile_y) * kTile * ws.padded_width + int64_t(tile_x) * kTile) {}

  GAUSSLITE_INLINE Pack16 pixel_x(int b) const { return load(kPixelX) + float(x * kTile + (b & 3) * kBlock); }
  GAUSSLITE_INLINE Pack16 pixel_y(int b) const { return load(kPixelY) + float(y * kTile + (b >> 2) * kBlock); }
  GAUSSLITE_INLINE int64_t block(const Workspace& ws, int b) const {
    return corner + int64_t(b >> 2) * kBlock * ws.padded_width + (b & 3) * kBlock;
  }
};

}  // namespace gausslite::GAUSSLITE_ISA
