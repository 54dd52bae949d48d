// SPDX-License-Identifier: Apache-2.0
// Sums the six moments of v = dL/d ln(alpha) (row_layout.h) over the sixteen pixels of a block, for sixteen (splat,
// block) pairs at a time.
//
// Multiplication limits the speed of the tile stages. A single pair, with a table of 1, x, y, xx, xy, yy, would take
// sixteen half-width multiplications. Here the otherwise idle shuffle units transpose sixteen pairs until each lane is
// one pair. The sums along x and then y are additions: all sixteen pairs take eleven multiplications.
#pragma once

#include <cstring>

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// Per entry of a chunk: sums of v, v·x, v·y, v·x², v·x·y, v·y², with (x, y) in half pixels from the tile's centre,
// where pixels have odd coordinates; two unused.
struct MomentSums {
  alignas(64) float by_entry[kChunk][8];

  GAUSSLITE_INLINE void clear(int n) {
    for (int i = 0; i < n; ++i) store8(by_entry[i], Pack8(0.0f));
  }
};

// Factors that convert the sums from half pixels to pixels.
alignas(32) constexpr float kMomentUnits[8] = {1.0f, 0.5f, 0.5f, 0.25f, 0.25f, 0.25f, 0.0f, 0.0f};

// Sum and first two moments of four values at -3, -1, 1, 3.
struct LineMoments {
  Pack16 sum, first, second;

  GAUSSLITE_INLINE LineMoments(Pack16 a, Pack16 b, Pack16 c, Pack16 d) {
    const Pack16 outer = a + d, inner = b + c;
    sum = outer + inner;
    first = fma(d - a, Pack16(3.0f), c - b);
    second = fma(outer, Pack16(9.0f), inner);
  }
};

// A batch of up to sixteen pairs. The caller writes `values[i]`: v at the sixteen pixels of pair i.
class MomentBatch {
 public:
  static constexpr int kSize = 16;
  alignas(64) float values[kSize][16];

  GAUSSLITE_INLINE int free_slots() const { return kSize - count_; }
  GAUSSLITE_INLINE int count() const { return count_; }

  // Adds the next n pairs, n at most free_slots(): entries list[0..n) with block b.
  GAUSSLITE_INLINE void add(const uint8_t* list, int n, int b, MomentSums& sums) {
    std::memcpy(entry_ + count_, list, kSize);
    store(block_x_ + count_, Pack16(float(8 * (b & 3) - 12)));
    store(block_y_ + count_, Pack16(float(8 * (b >> 2) - 12)));
    count_ += n;
    if (count_ == kSize) flush(sums);
  }

  GAUSSLITE_INLINE void flush(MomentSums& sums) {
    Pack16 along_x[3][4];
    for (int i = 0; i < 4; ++i) {
      Pack16 column[4];
      for (int k = 0; k < 4; ++k) column[k] = load(values[4 * i + k]);
      transpose_within_quads(column[0], column[1], column[2], column[3]);
      const LineMoments x(column[0], column[1], column[2], column[3]);
      along_x[0][i] = x.sum;
      along_x[1][i] = x.first;
      along_x[2][i] = x.second;
    }
    for (Pack16(&row)[4] : along_x) transpose_whole_quads(row[0], row[1], row[2], row[3]);
    const Pack16 *one = along_x[0], *x = along_x[1], *xx = along_x[2];
    const LineMoments y(one[0], one[1], one[2], one[3]), xy(x[0], x[1], x[2], x[3]);
    const Pack16 sum_xx = (xx[0] + xx[3]) + (xx[1] + xx[2]);

    // Shift from the block's centre to the tile's.
    const Pack16 block_x = load(block_x_), block_y = load(block_y_);
    const Pack16 moment_x = fma(block_x, y.sum, xy.sum), moment_y = fma(block_y, y.sum, y.first);
    const Pack16 moment_xx = fma(block_x, xy.sum + moment_x, sum_xx),
                 moment_yy = fma(block_y, y.first + moment_y, y.second);
    const Pack16 moment_xy = fma(block_x, moment_y, fma(block_y, xy.sum, xy.first));

    Pack16 low[4] = {y.sum, moment_x, moment_y, moment_xx},
           high[4] = {moment_xy, moment_yy, Pack16(0.0f), Pack16(0.0f)};
    transpose_within_quads(low[0], low[1], low[2], low[3]);
    transpose_within_quads(high[0], high[1], high[2], high[3]);
    for (int k = 0; k < 4; ++k) {
      Pack8 moments[4];
      pair_quads(low[k], high[k], moments);
      for (int i = 0; i < 4; ++i) {
        if (4 * i + k >= count_) break;
        float* out = sums.by_entry[entry_[4 * i + k]];
        store8(out, load8(out) + moments[i]);
      }
    }
    count_ = 0;
  }

 private:
  // Padded for whole-register writes.
  uint8_t entry_[2 * kSize];
  alignas(64) float block_x_[2 * kSize], block_y_[2 * kSize];
  int count_ = 0;
};

}  // namespace gausslite::GAUSSLITE_ISA
