// SPDX-License-Identifier: Apache-2.0
// Stage 5: SSIM and its derivatives by the window means, in squares of 16x16 pixels.
//
// With the window mean E of the image x and the target y: S = A1 A2 / (B1 B2), A1 = 2 Ex Ey + C1, A2 = 2 (Exy - Ex Ey)
// + C2, B1 = Ex^2 + Ey^2 + C1, B2 = Exx - Ex^2 + Eyy - Ey^2 + C2. The gradient at a pixel is the blur of dS/dEx, plus
// 2x times that of dS/dExx, plus y times that of dS/dExy. Pixels outside the image count as zero.
//
// The squares lie half a tile higher than the tiles: row k of them spans image rows 16 k - 8 ... 16 k + 7, so that its
// windows see the tile rows k - 1 and k only, and the gradient of tile row s needs rows s and s + 1 of them only. A
// square goes through four blurs. Down the image sixteen columns are blurred at once; then the square is transposed and
// "down" is along the image rows, so that every load is one aligned cache line. There SSIM is formed and its
// derivatives are blurred along the rows; they are transposed back and stored; and what is left, the blur down, is done
// where a tile needs its gradient (ssim_gradient.h). From one square to the next everything is in the first-level
// cache.
#include <algorithm>

#include "ssim_window.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

// Transposed columns of one row of squares: what was blurred down the image, and the derivatives. Sixteen columns of
// zeros lie on either side.
class Columns {
 public:
  static size_t floats(int tiles_x) { return 2 * kSsimMaps * map_floats(tiles_x); }

  Columns(float* memory, int tiles_x) : memory_(memory), map_(map_floats(tiles_x)) {
    for (size_t k = 0; k < 2 * kSsimMaps; ++k) {
      std::fill_n(memory + k * map_, kSquare, 0.0f);
      std::fill_n(memory + (k + 1) * map_ - kSquare, kSquare, 0.0f);
    }
  }

  // The sixteen columns of square x, 16 floats each.
  float* blurred(int k, int x) { return memory_ + size_t(k) * map_ + size_t(x + 1) * kSquare; }
  float* derivative(int k, int x) { return blurred(kSsimMaps + k, x); }

 private:
  static size_t map_floats(int tiles_x) { return size_t(tiles_x + 2) * kSquare; }

  float* memory_;
  size_t map_;
};

// A square lies on two tiles; beyond the image there is nothing.
struct Square {
  const float *upper, *lower;

  GAUSSLITE_INLINE Pack16 row(int i) const { return row_between(upper, lower, i); }
};

Square image_square(const SquareRow& row, int x, int channel) {
  const size_t at = image_tile(x) + size_t(channel) * kSquare;
  return {row.above != nullptr ? row.above->image.data() + at : kNoSquares,
          row.below != nullptr ? row.below->image.data() + at : kNoSquares};
}

Square target_square(const float* tiles, int tiles_x, int tiles_y, int k, int x, int channel) {
  const float* lower = tiles + ((size_t(k) * size_t(tiles_x) + size_t(x)) * kTargets + size_t(channel)) * kSquare;
  return {k > 0 ? lower - size_t(tiles_x) * kTargets * kSquare : kNoSquares, k < tiles_y ? lower : kNoSquares};
}

template <class Get>
GAUSSLITE_INLINE void blur_and_transpose(Get get, float* out) {
  Pack16 rows[kTile];
  blur(get, [&](int i, Pack16 sum) { rows[i] = sum; });
  transpose(rows);
  for (int i = 0; i < kTile; ++i) store(out + i * kTile, rows[i]);
}

// `columns` of the square itself; the window reaches into its neighbours left and right.
GAUSSLITE_INLINE Pack16 column(const float* columns, int i) { return load(columns + (i - kRadius) * kTile); }

// Where SsimTargets::moments has the mean of a channel; the mean square is behind it.
size_t moments_at(int tiles_x, int k, int channel, int x) {
  return ((size_t(k) * 3 + size_t(channel)) * size_t(tiles_x) + size_t(x)) * 2 * kSquare;
}

// Forms SSIM and its derivatives in one square. Returns the sum of SSIM times the (negative) weights.
double derive(Columns& columns, int x, const float* moments, const float* weights, float scale) {
  Pack16 mean[kSsimMaps][kTile];
  for (int k = 0; k < kSsimMaps; ++k) {
    const float* in = columns.blurred(k, x);
    blur([&](int i) { return column(in, i); }, [&](int i, Pack16 sum) { mean[k][i] = sum; });
  }
  float* by[kSsimMaps] = {columns.derivative(0, x), columns.derivative(1, x), columns.derivative(2, x)};
  Pack16 total(0.0f);
  for (int i = 0; i < kTile; ++i) {
    const Pack16 Ex = mean[0][i], Exx = mean[1][i], Exy = mean[2][i];
    const Pack16 Ey = load(moments + i * kTile), Eyy = load(moments + kSquare + i * kTile);
    const Pack16 given = load(weights + i * kTile), weight = given * -scale;
    const Pack16 cross = Ex * Ey, Ex2 = Ex * Ex, Ey2 = Ey * Ey;
    const Pack16 A1 = fma(cross, Pack16(2.0f), Pack16(kC1)), A2 = fma(Exy - cross, Pack16(2.0f), Pack16(kC2));
    const Pack16 B1 = Ex2 + Ey2 + kC1, B2 = (Exx - Ex2) + (Eyy - Ey2) + kC2;
    const Pack16 inverse = Pack16(1.0f) / (B1 * B2), S = A1 * A2 * inverse, scaled = weight * inverse;
    const Pack16 by_A1 = A2 * scaled, by_A2 = A1 * scaled, by_B1 = -(S * B2 * scaled), by_B2 = -(S * B1 * scaled);
    const Pack16 by_Ex = fma(Ey, by_A1 - by_A2, Ex * (by_B1 - by_B2));
    // Where there is no weight the windows may hold pixels that were never drawn.
    const Mask16 counts = given > Pack16(0.0f);
    total = total + keep(counts, S * weight);
    store(by[0] + i * kTile, keep(counts, by_Ex + by_Ex));
    store(by[1] + i * kTile, keep(counts, by_B2));
    store(by[2] + i * kTile, keep(counts, by_A2 + by_A2));
  }
  return double(sum(total));
}

}  // namespace

void derive_ssim(Workspace& ws, const Training& training, const SquareRow& row, int thread) {
  const Targets& t = training.targets;
  const int k = row.k;
  const uint8_t* reach = t.ssim.reach + size_t(k) * size_t(ws.tiles_x);
  double& loss = training.ssim_sums[k] = 0.0;
  if (!std::any_of(reach, reach + ws.tiles_x, [](uint8_t r) { return r == kWeighted; })) return;
  Buffer<float>& memory = ws.scratch[size_t(thread)].ssim;
  memory.reserve(ssim_scratch_floats(ws.tiles_x));
  Columns columns(memory.data(), ws.tiles_x);
  for (int channel = 0; channel < 3; ++channel) {
    // Square x is blurred down, x - 1 derived, x - 2 blurred along: each needs its right neighbour's former step.
    for (int x = 0; x < ws.tiles_x + 2; ++x) {
      if (x < ws.tiles_x && reach[x] != kUnreached) {
        const Square image = image_square(row, x, channel),
                     target = target_square(t.tiles, ws.tiles_x, ws.tiles_y, k, x, channel);
        blur_and_transpose([&](int i) { return image.row(i); }, columns.blurred(0, x));
        blur_and_transpose([&](int i) { return image.row(i) * image.row(i); }, columns.blurred(1, x));
        blur_and_transpose([&](int i) { return image.row(i) * target.row(i); }, columns.blurred(2, x));
      }
      const int middle = x - 1;
      if (middle >= 0 && middle < ws.tiles_x) {
        if (reach[middle] == kWeighted) {
          const float* weights = t.ssim.weights + (size_t(k) * size_t(ws.tiles_x) + size_t(middle)) * kSquare;
          loss += derive(columns, middle, t.ssim.moments + moments_at(ws.tiles_x, k, channel, middle), weights,
                         training.loss.ssim);
        } else {
          for (int m = 0; m < kSsimMaps; ++m) std::fill_n(columns.derivative(m, middle), kSquare, 0.0f);
        }
      }
      const int last = x - 2;
      if (last >= 0 && reach[last] != kUnreached) {
        for (int m = 0; m < kSsimMaps; ++m) {
          const float* in = columns.derivative(m, last);
          blur_and_transpose([&](int i) { return column(in, i); }, row.squares + ssim_square(last, channel, m));
        }
      }
    }
  }
}

size_t ssim_scratch_floats(int tiles_x) { return Columns::floats(tiles_x); }

void prepare_ssim(const float* target_tiles, int tiles_x, int tiles_y, float* moments, float* scratch) {
  Columns columns(scratch, tiles_x);
  for (int k = 0; k <= tiles_y; ++k) {
    for (int channel = 0; channel < 3; ++channel) {
      for (int x = 0; x < tiles_x; ++x) {
        const Square target = target_square(target_tiles, tiles_x, tiles_y, k, x, channel);
        blur_and_transpose([&](int i) { return target.row(i); }, columns.blurred(0, x));
        blur_and_transpose([&](int i) { return target.row(i) * target.row(i); }, columns.blurred(1, x));
      }
      for (int x = 0; x < tiles_x; ++x) {
        float* out = moments + moments_at(tiles_x, k, channel, x);
        for (int m = 0; m < 2; ++m, out += kSquare) {
          const float* in = columns.blurred(m, x);
          blur([&](int i) { return column(in, i); }, [&](int i, Pack16 sum) { store(out + i * kTile, sum); });
        }
      }
    }
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
