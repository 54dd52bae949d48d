// SPDX-License-Identifier: Apache-2.0
// The backward pass of one 4x4 block, in front-to-back order, and its sums per entry: the index of a splat in the
// tile's current chunk (Workspace's kChunk). T_i is the transmittance in front of splat i; <a, b> is the dot product.
//
// With weights w_i = alpha_i T_i and q_i = <dL/d(rgb, depth, alpha), (rgb_i, depth_i, 1)>, the derivative
// with respect to ln(alpha_i) is w_i q_i - alpha_i / (1 - alpha_i) S_i with the suffix sum S_i = sum over k > i of w_k
// q_k. S_i is the total minus the prefix sum, and the finished pixel gives the total. So one running scalar per pixel
// suffices, without a division chain for the transmittance or a back-to-front pass.
#pragma once

#include "block_forward.h"
#include "moment_batch.h"
#include "row_layout.h"
#include "simd/pack.h"
#include "tile_chunk.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen pixels: gradients of r g b depth alpha, the running transmittance and the suffix sum.
struct BlockGradient {
  Pack16 d_image[5];
  Pack16 d_columns[4];  // lane 4 y + c of element x: gradient of channel c (r g b depth) at pixel (x, y)
  Pack16 transmittance, suffix_sum;

  // `image`: the finished pixels, r g b depth and transmittance.
  GAUSSLITE_INLINE void start(const Pack16 (&gradient)[5], const Pack16 (&image)[5]) {
    suffix_sum = gradient[4] * (Pack16(1.0f) - image[4]);
    for (int k = 0; k < 4; ++k) suffix_sum = fma(gradient[k], image[k], suffix_sum);
    for (int k = 0; k < 5; ++k) d_image[k] = gradient[k];
    for (int k = 0; k < 4; ++k) d_columns[k] = gradient[k];
    transpose_within_quads(d_columns[0], d_columns[1], d_columns[2], d_columns[3]);
    transmittance = Pack16(1.0f);
  }
};

// Per entry of a chunk: the moments of v = dL/d ln(alpha), and the weights times the channel gradients, summed per
// pixel row.
struct ChunkSums {
  MomentSums moments;
  Pack16 colours[kChunk];

  GAUSSLITE_INLINE void clear(int n) {
    moments.clear(n);
    for (int i = 0; i < n; ++i) colours[i] = Pack16(0.0f);
  }
};

// Adds the weights of sixteen pixels times their channel gradients, summed over the columns of the block.
GAUSSLITE_INLINE Pack16 add_colours(Pack16 weight, const Pack16 (&d_columns)[4], Pack16 sums) {
  const Pack16 even =
      fma(broadcast_within_quads<2>(weight), d_columns[2], fma(broadcast_within_quads<0>(weight), d_columns[0], sums));
  const Pack16 odd =
      fma(broadcast_within_quads<3>(weight), d_columns[3], broadcast_within_quads<1>(weight) * d_columns[1]);
  return even + odd;
}

// Alphas above this are taken as clamped to 0.99 (kLog2MaxAlpha), so that their gradient is 0.
constexpr float kBelowMaxAlpha = 0.989995f;

// Backward pass over n entries of a block's list. kFromAlphas: reads the alphas of the forward pass; otherwise computes
// them again.
template <bool kFromAlphas>
GAUSSLITE_INLINE void backward_block(const Splat* records, const uint8_t* list, int n, const TilePosition& tile, int b,
                                     BlockGradient& gradient, ChunkSums& sums, MomentBatch& batch,
                                     const float*& alphas) {
  const Pack16 pixel_x = tile.pixel_x(b), pixel_y = tile.pixel_y(b);
  // The compiler keeps a local copy without aliases in registers.
  BlockGradient g = gradient;
  for (int begin = 0, batch_size; begin < n; begin += batch_size) {
    batch_size = n - begin < batch.free_slots() ? n - begin : batch.free_slots();
    float (*values)[16] = batch.values + batch.count();
    for (int i = 0; i < batch_size; ++i) {
      const int entry = list[begin + i];
      const Splat& s = records[entry];
      Pack16 alpha;
      if (kFromAlphas) {
        alpha = load(alphas);
        alphas += 16;
      } else {
        alpha = zero_unless(g.transmittance >= Pack16(kMinTransmittance), alpha_of(s, pixel_x, pixel_y));
      }
      const Pack16 weight = alpha * g.transmittance;
      Pack16 q = fma(g.d_image[0], Pack16(s.r), g.d_image[4]);
      q = fma(g.d_image[1], Pack16(s.g), q);
      q = fma(g.d_image[2], Pack16(s.b), q);
      q = fma(g.d_image[3], Pack16(s.depth), q);
      const Pack16 contribution = weight * q;
      g.suffix_sum = g.suffix_sum - contribution;
      g.transmittance = fnma(alpha, g.transmittance, g.transmittance);
      const Pack16 odds = alpha * reciprocal(Pack16(1.0f) - alpha);
      store(values[i], zero_unless(alpha < Pack16(kBelowMaxAlpha), fnma(g.suffix_sum, odds, contribution)));
      sums.colours[entry] = add_colours(weight, g.d_columns, sums.colours[entry]);
    }
    batch.add(list + begin, batch_size, b, sums.moments);
  }
  gradient.transmittance = g.transmittance;
  gradient.suffix_sum = g.suffix_sum;
}

// Shifts moments to another reference point, at offset (x, y) from the old one, in two fused steps. The first subtracts
// from each sum its lower neighbour times x or y; the second repeats this for the second-order sums. `xy` repeats x, y;
// lanes 6 and 7 of the moments are zero and feed the lanes that a step does not change.
GAUSSLITE_INLINE Pack8 shift_moments(Pack8 m, Pack8 xy) {
  m = fnma(permute<0, 0, 1, 0, 1, 1, 0, 0>(xy), permute<6, 0, 0, 1, 1, 2, 6, 6>(m), m);
  return fnma(permute<0, 0, 0, 0, 0, 1, 0, 0>(xy), permute<6, 6, 6, 1, 2, 2, 6, 6>(m), m);
}

GAUSSLITE_INLINE float* gradient_row(Workspace& ws, const Splat& splat, const TilePosition& tile) {
  return ws.gradient_rows.data() + size_t(kRowWidth) * uint32_t(splat.gradient_row_minus_tile_y + uint32_t(tile.y));
}

GAUSSLITE_INLINE void prefetch_rows(Workspace& ws, const Splat* records, int n, const TilePosition& tile) {
  for (int i = 0; i < n; ++i) prefetch_to_write(gradient_row(ws, records[i], tile));
}

// Shifts a chunk's moments from the tile's centre to the splats' means, converts them to pixels, and adds them to the
// gradient rows of this tile row.
GAUSSLITE_INLINE void add_to_rows(Workspace& ws, const Splat* records, int n, const TilePosition& tile,
                                  const ChunkSums& sums) {
  const float centre_x = float(tile.x * kTileSide + kTileSide / 2),
              centre_y = float(tile.y * kTileSide + kTileSide / 2);
  alignas(32) const float centres[8] = {centre_x, centre_y, centre_x, centre_y, centre_x, centre_y, centre_x, centre_y};
  const Pack8 centre = load8(centres), units = load8(kMomentUnits);
  const Pack16 pass(__builtin_bit_cast(float, ws.gradient_pass));
  for (int i = 0; i < n; ++i) {
    const Pack8 offset = broadcast_pair(&records[i].mean_x) - centre;
    const Pack8 moments = shift_moments(load8(sums.moments.by_entry[i]), offset + offset) * units;
    float* row = gradient_row(ws, records[i], tile);
    uint32_t row_pass;
    std::memcpy(&row_pass, row + kPassNumber, sizeof row_pass);
    const Pack16 total =
        join(moments, sum_of_quads(sums.colours[i])) + zero_unless(row_pass == ws.gradient_pass, load(row));
    store(row, select(first_lanes(kPassNumber), total, pass));
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
