// SPDX-License-Identifier: Apache-2.0
// Gathers a chunk of a tile's splats (kChunk in workspace.h), and converts their block masks to one list per block. An
// entry is the index of a splat in its chunk, 0 to kChunk - 1. A splat's place in the tile's whole list is its
// position.
#pragma once

#include <algorithm>
#include <cstring>

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// For each byte, the entries of its set bits in ascending order. Bits 0, 2, 4, 6 are entries 0 to 3; bits 1, 3, 5, 7
// are entries 4 to 7: BlockBytes interleaves the masks of both halves, which are two loads of four masks.
struct SetBits {
  uint64_t entries[256] = {};  // bytes, in little-endian order
  uint8_t count[256] = {};

  constexpr SetBits() {
    for (uint32_t byte = 0; byte < 256; ++byte) {
      for (uint64_t entry = 0; entry < 8; ++entry) {
        const uint64_t bit = entry < 4 ? 2 * entry : 2 * entry - 7;
        if ((byte >> bit & 1u) != 0) entries[byte] |= entry << (8 * count[byte]++);
      }
    }
  }
};
inline constexpr SetBits kSetBits;

// Transposed masks of eight entries. Byte b of half[0] has a bit for each entry that touches block b; byte b of half[1]
// has one for each that touches block 8 + b.
struct BlockBytes {
  uint64_t half[2];

  GAUSSLITE_INLINE explicit BlockBytes(const uint16_t* masks) {
    constexpr uint64_t kLow = 0x00FF00FF00FF00FFu;
    uint64_t a, b;
    std::memcpy(&a, masks, sizeof a);
    std::memcpy(&b, masks + 4, sizeof b);
    half[0] = transposed((a & kLow) | (b & kLow) << 8);
    half[1] = transposed((a >> 8 & kLow) | (b & ~kLow));
  }

 private:
  // 8x8 bit transposes: exchange the off-diagonal quarters of squares of increasing size.
  GAUSSLITE_INLINE static uint64_t transposed(uint64_t rows) {
    uint64_t swap = (rows ^ rows >> 7) & 0x00AA00AA00AA00AAu;
    rows ^= swap ^ swap << 7;
    swap = (rows ^ rows >> 14) & 0x0000CCCC0000CCCCu;
    rows ^= swap ^ swap << 14;
    swap = (rows ^ rows >> 28) & 0x00000000F0F0F0F0u;
    return rows ^ swap ^ swap << 28;
  }
};

// Converts n masks of 16 blocks to 16 lists of entries: a bit-matrix transpose.
#if defined(GAUSSLITE_USE_AVX512)
// 32 entries at a time: vptestmw selects one block's bits, vpcompressb writes those entries.
GAUSSLITE_INLINE void list_blocks(const uint16_t* block_masks, int n, BlockLists& lists) {
  alignas(32) static constexpr uint8_t kEntries[32] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15,
                                                       16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
  uint32_t count[kBlocksPerTile] = {};
  for (int i = 0; i < n; i += 32) {
    const __mmask32 present = n - i >= 32 ? 0xFFFFFFFFu : (1u << (n - i)) - 1u;
    const __m512i masks = _mm512_maskz_loadu_epi16(present, block_masks + i);
    const __m256i entries =
        _mm256_add_epi8(_mm256_load_si256(reinterpret_cast<const __m256i*>(kEntries)), _mm256_set1_epi8(char(i)));
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const __mmask32 touching = _mm512_test_epi16_mask(masks, _mm512_set1_epi16(short(1u << b)));
      _mm256_storeu_si256(reinterpret_cast<__m256i*>(lists.entry[b] + count[b]),
                          _mm256_maskz_compress_epi8(touching, entries));
      count[b] += uint32_t(__builtin_popcount(touching));
    }
  }
  lists.end(count);
}
#else
// Eight entries at a time: their masks become sixteen bytes, one per block, and a table converts each to entries.
// No branch: the number of blocks of an entry is unpredictable.
GAUSSLITE_INLINE void list_blocks(const uint16_t* block_masks, int n, BlockLists& lists) {
  uint32_t count[kBlocksPerTile] = {};
  const auto list = [&](const uint16_t* masks, int i) {
    const BlockBytes bytes(masks);
    const uint64_t first = uint64_t(i) * 0x0101010101010101u;
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const uint32_t mask = uint32_t(bytes.half[b / 8] >> (8 * (b % 8))) & 0xFFu;
      const uint64_t entries = kSetBits.entries[mask] + first;
      std::memcpy(lists.entry[b] + count[b], &entries, sizeof entries);
      count[b] += kSetBits.count[mask];
    }
  };
  int i = 0;
  for (; i + 8 <= n; i += 8) list(block_masks + i, i);
  uint16_t last[8] = {};
  std::copy(block_masks + i, block_masks + n, last);
  list(last, i);
  lists.end(count);
}
#endif

// Loads positions [first, first + n) of a tile's list, n at most kChunk, and prefetches the next chunk's splats.
GAUSSLITE_INLINE void load_chunk(const Workspace& ws, const TileList& tile, uint32_t first, int n, Splat* records,
                                 BlockLists& lists) {
  const uint32_t* slots = &tile.slots[first];
  for (int i = 0; i < n; ++i) {
    store(reinterpret_cast<float*>(&records[i]), load(reinterpret_cast<const float*>(&ws.splats[slots[i]])));
    prefetch(&ws.splats[slots[i + kChunk]]);
  }
  list_blocks(&tile.blocks[first], n, lists);
}

// Pixel centres of a block, relative to its corner.
alignas(64) constexpr float kPixelX[16] = {.5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f,
                                           .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f};
alignas(64) constexpr float kPixelY[16] = {.5f,  .5f,  .5f,  .5f,  1.5f, 1.5f, 1.5f, 1.5f,
                                           2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};

struct TilePosition {
  int x, y;        // tile column and row
  int64_t corner;  // offset of its first pixel in an image plane

  GAUSSLITE_INLINE TilePosition(const Workspace& ws, int tile_x, int tile_y)
      : x(tile_x), y(tile_y), corner(int64_t(tile_y) * kTileSide * ws.padded_width + int64_t(tile_x) * kTileSide) {}

  GAUSSLITE_INLINE Pack16 pixel_x(int b) const { return load(kPixelX) + float(x * kTileSide + (b & 3) * kBlockSide); }
  GAUSSLITE_INLINE Pack16 pixel_y(int b) const { return load(kPixelY) + float(y * kTileSide + (b >> 2) * kBlockSide); }
  GAUSSLITE_INLINE int64_t block_offset(const Workspace& ws, int b) const {
    return corner + int64_t(b >> 2) * kBlockSide * ws.padded_width + (b & 3) * kBlockSide;
  }
};

}  // namespace gausslite::GAUSSLITE_ISA
