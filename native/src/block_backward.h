// SPDX-License-Identifier: Apache-2.0
// The way back through one 4x4 block, again front to back, and the sums that its pixels leave at each splat.
//
// With weights w_i = alpha_i T_i and q_i = <dL/d(rgb, depth, alpha), (rgb_i, depth_i, 1)>, the derivative by
// ln(alpha_i) is w_i q_i - alpha_i / (1 - alpha_i) S_i, where S_i = sum over k > i of w_k q_k is what lies behind. S_i
// is the total minus the prefix, and the total is known from the finished pixel: one running scalar a pixel, no
// division chain for the transmittance, and no second walk from the back.
#pragma once

#include "block_forward.h"
#include "row_layout.h"
#include "simd/pack.h"
#include "tile_chunk.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// The gradients of sixteen pixels: r g b depth alpha; and the running transmittance and suffix.
struct BlockGradient {
  Pack16 by[5];
  Pack16 by_column[4];  // lane 4 y + c of element x: gradient of channel c (r g b depth) at pixel (x, y)
  Pack16 transmittance, behind;

  // `image` holds the finished pixels: r g b depth and the transmittance left.
  GAUSSLITE_INLINE void start(const Pack16 (&gradient)[5], const Pack16 (&image)[5]) {
    behind = gradient[4] * (Pack16(1.0f) - image[4]);
    for (int k = 0; k < 4; ++k) behind = fma(gradient[k], image[k], behind);
    for (int k = 0; k < 5; ++k) by[k] = gradient[k];
    for (int k = 0; k < 4; ++k) by_column[k] = gradient[k];
    transpose_quads(by_column[0], by_column[1], by_column[2], by_column[3]);
    transmittance = Pack16(1.0f);
  }
};

// Per entry of a chunk: v = dL/d ln(alpha) summed with 1, x, y, xx, xy, yy around the tile's centre; and the weights
// times the channel gradients, still one sum per pixel row.
struct ChunkSums {
  alignas(64) float moments[kChunk][8];
  Pack16 colours[kChunk];

  GAUSSLITE_INLINE void clear(int n) {
    for (int i = 0; i < n; ++i) {
      store8(moments[i], Pack8(0.0f));
      colours[i] = Pack16(0.0f);
    }
  }
};

// 1, x, y, xx, xy, yy, 0, 0 of every pixel, around the tile's centre.
struct MomentTable {
  alignas(64) float value[kBlocks][16][8];

  constexpr MomentTable() : value() {
    for (int b = 0; b < kBlocks; ++b) {
      for (int i = 0; i < 16; ++i) {
        const float x = float(4 * (b & 3) + (i & 3)) - 7.5f, y = float(4 * (b >> 2) + (i >> 2)) - 7.5f;
        const float moments[8] = {1.0f, x, y, x * x, x * y, y * y, 0.0f, 0.0f};
        for (int k = 0; k < 8; ++k) value[b][i][k] = moments[k];
      }
    }
  }
};
inline constexpr MomentTable kMomentTable;

// Adds one entry's sixteen values of v and w to the chunk's sums.
GAUSSLITE_INLINE void reduce_entry(const float* v, const float* w, const Pack8 (&table)[16],
                                   const BlockGradient& gradient, float* moments, Pack16& colours) {
  Pack8 sum0 = load8(moments), sum1(0.0f), sum2(0.0f), sum3(0.0f);
  for (int p = 0; p < 16; p += 4) {
    sum0 = fma(table[p], broadcast8(v + p), sum0);
    sum1 = fma(table[p + 1], broadcast8(v + p + 1), sum1);
    sum2 = fma(table[p + 2], broadcast8(v + p + 2), sum2);
    sum3 = fma(table[p + 3], broadcast8(v + p + 3), sum3);
  }
  store8(moments, (sum0 + sum1) + (sum2 + sum3));
  const Pack16 weights = load(w);
  const Pack16 even = fma(spread_in_quads<2>(weights), gradient.by_column[2],
                          fma(spread_in_quads<0>(weights), gradient.by_column[0], colours));
  const Pack16 odd =
      fma(spread_in_quads<3>(weights), gradient.by_column[3], spread_in_quads<1>(weights) * gradient.by_column[1]);
  colours = even + odd;
}

constexpr float kBelowMaxAlpha = 0.989995f;
constexpr int kBatch = 16;

// Walks n entries of a block's list. With kFromAlphas the alphas of the forward pass are read back, otherwise computed
// again. Entries go in batches through two loops: per-pixel values first, then the sums, whose tables want the
// registers for themselves.
template <bool kFromAlphas>
GAUSSLITE_INLINE void walk_back(const Splat* records, const uint8_t* list, int n, const TilePosition& tile, int b,
                                BlockGradient& gradient, ChunkSums& sums, const float*& alphas) {
  const Pack16 pixel_x = tile.pixel_x(b), pixel_y = tile.pixel_y(b);
  Pack16 transmittance = gradient.transmittance, behind = gradient.behind;
  alignas(64) float w[kBatch][16], v[kBatch][16];
  for (int begin = 0; begin < n; begin += kBatch) {
    const int batch = n - begin < kBatch ? n - begin : kBatch;
    for (int i = 0; i < batch; ++i) {
      const Splat& s = records[list[begin + i]];
      Pack16 alpha;
      Mask16 unclamped;
      if (kFromAlphas) {
        alpha = load(alphas);
        alphas += 16;
        unclamped = alpha < Pack16(kBelowMaxAlpha);
      } else {
        const Pack16 exponent = log2_alpha(s, pixel_x, pixel_y);
        const Mask16 counts = (exponent >= Pack16(kLog2MinAlpha)) & (transmittance >= Pack16(kMinTransmittance));
        alpha = keep(counts, exp2_fast(min(exponent, Pack16(kLog2MaxAlpha))));
        unclamped = exponent < Pack16(kLog2MaxAlpha);
      }
      const Pack16 weight = alpha * transmittance;
      Pack16 q = fma(gradient.by[0], Pack16(s.r), gradient.by[4]);
      q = fma(gradient.by[1], Pack16(s.g), q);
      q = fma(gradient.by[2], Pack16(s.b), q);
      q = fma(gradient.by[3], Pack16(s.depth), q);
      const Pack16 own = weight * q;
      behind = behind - own;
      transmittance = transmittance - weight;
      const Pack16 odds = alpha * rough_reciprocal(Pack16(1.0f) - alpha);
      store(w[i], weight);
      store(v[i], keep(unclamped, fnma(behind, odds, own)));
    }
    Pack8 table[16];
    for (int p = 0; p < 16; ++p) table[p] = load8(kMomentTable.value[b][p]);
    for (int i = 0; i < batch; ++i) {
      const int entry = list[begin + i];
      reduce_entry(v[i], w[i], table, gradient, sums.moments[entry], sums.colours[entry]);
    }
  }
  gradient.transmittance = transmittance;
  gradient.behind = behind;
}

// Shifts moments by (x, y): about a point at that offset from the one they are about. Two fused steps: first every sum
// less its lower neighbour times x or y, then the second-order ones once more from the results. `xy` repeats x, y;
// lanes 6 and 7 of the moments are zero and serve the lanes that a step leaves alone.
GAUSSLITE_INLINE Pack8 shift_moments(Pack8 m, Pack8 xy) {
  m = fnma(permute<0, 0, 1, 0, 1, 1, 0, 0>(xy), permute<6, 0, 0, 1, 1, 2, 6, 6>(m), m);
  return fnma(permute<0, 0, 0, 0, 0, 1, 0, 0>(xy), permute<6, 6, 6, 1, 2, 2, 6, 6>(m), m);
}

GAUSSLITE_INLINE float* gradient_row(Workspace& ws, const Splat& splat, const TilePosition& tile) {
  return ws.gradient_rows.data() + size_t(kRowWidth) * uint32_t(splat.gradient_row + uint32_t(tile.y));
}

GAUSSLITE_INLINE void prefetch_rows(Workspace& ws, const Splat* records, int n, const TilePosition& tile) {
  for (int i = 0; i < n; ++i) __builtin_prefetch(gradient_row(ws, records[i], tile), 0, 2);
}

// Moves a chunk's moments from the tile's centre to the splats' means and adds them to the gradient rows of this tile
// row.
GAUSSLITE_INLINE void add_to_rows(Workspace& ws, const Splat* records, int n, const TilePosition& tile,
                                  const ChunkSums& sums) {
  const float centre_x = float(tile.x * kTile + kTile / 2), centre_y = float(tile.y * kTile + kTile / 2);
  alignas(32) const float centres[8] = {centre_x, centre_y, centre_x, centre_y, centre_x, centre_y, centre_x, centre_y};
  const Pack8 centre = load8(centres);
  for (int i = 0; i < n; ++i) {
    const Pack8 moments = shift_moments(load8(sums.moments[i]), broadcast_pair(&records[i].mean_x) - centre);
    float* row = gradient_row(ws, records[i], tile);
    uint32_t tag;
    std::memcpy(&tag, row + kRowTag, sizeof tag);
    const bool fresh = tag == ws.tag;
    store8(row, moments + keep_if(fresh, load8(row)));
    store8(row + 8, sum_of_quads(sums.colours[i]) + keep_if(fresh, load8(row + 8)));
    std::memcpy(row + kRowTag, &ws.tag, sizeof ws.tag);
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
