// SPDX-License-Identifier: Apache-2.0
// SSIM (Wang et al. 2004) and its derivatives with respect to the window means, in squares of 16x16 pixels.
//
// With the window mean E of the rendered image x and the training image y: S = A1 A2 / (B1 B2), A1 = 2 Ex Ey + C1, A2 =
// 2 (Exy - Ex Ey)
// + C2, B1 = Ex^2 + Ey^2 + C1, B2 = E(xx + yy) - Ex^2 - Ey^2 + C2. The gradient at a pixel is the blur of dS/dEx, plus
// 2x times that of dS/dExx, plus y times that of dS/dExy. Pixels outside the image count as zero.
//
// The squares lie half a tile higher than the tiles: row k spans image rows 16 k - 8 ... 16 k + 7. So its windows reach
// only the tile rows k - 1 and k, and the gradient of tile row s needs only rows s and s + 1 of the squares.
//
// A square needs four blurs. The first, down the image, processes sixteen columns at once. Then the square is
// transposed, so that the blur along the rows loads aligned cache lines. SSIM is computed there, and its derivatives
// are blurred along the rows, transposed back and stored. The last blur, down the image, runs where a tile needs its
// gradient (ssim_gradient.h). The data of successive squares stay in the first-level cache. The blurs of y
// and y² are computed again in each step: that costs less than loading stored ones from memory.
#include <algorithm>

#include "image_tile.h"
#include "ssim_window.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

// Number of blurred quantities of the forward pass: x, y, xx + yy, xy.
constexpr int kMeans = 4;

// Transposed columns of one row of squares: the quantities blurred down the image, and the derivatives. Sixteen columns
// of zeros pad either side.
class Columns {
 public:
  Columns(Buffer<float>& memory, int tiles_x) : map_(size_t(tiles_x + 2) * kTilePixels) {
    memory.ensure_capacity((kMeans + kSsimMaps) * map_);
    memory_ = memory.data();
    for (size_t k = 0; k < kMeans + kSsimMaps; ++k) {
      std::fill_n(memory_ + k * map_, kTilePixels, 0.0f);
      std::fill_n(memory_ + (k + 1) * map_ - kTilePixels, kTilePixels, 0.0f);
    }
  }

  // The sixteen columns of square x, 16 floats each.
  float* blurred(int k, int x) { return memory_ + size_t(k) * map_ + size_t(x + 1) * kTilePixels; }
  float* derivative(int k, int x) { return blurred(kMeans + k, x); }

 private:
  size_t map_;
  float* memory_;
};

// Row k of the SSIM squares. Each square overlaps two tiles. Beyond the image all values are zero.
class Squares {
 public:
  Squares(const Workspace& ws, const TrainingImage& training_image, const SsimSquareRow& row)
      : training_image_(training_image),
        row_(row),
        upper_(size_t(std::max(row.k - 1, 0)) * size_t(ws.tiles_x)),
        lower_(size_t(row.k) * size_t(ws.tiles_x)) {}

  // Writes the 26 rows of a channel that the windows of square x reach.
  GAUSSLITE_INLINE void rendered_rows(int x, int channel, float* out) const {
    const size_t at = image_offset(x) + size_t(channel) * kTilePixels;
    const float* upper = row_.above != nullptr ? row_.above->image.data() + at : kZeroSquares;
    const float* lower = row_.below != nullptr ? row_.below->image.data() + at : kZeroSquares;
    for (int i = 0; i < kSpan; ++i) store(out + i * kTileSide, row_between(upper, lower, i));
  }
  GAUSSLITE_INLINE void training_rows(int x, int channel, float* out) const {
    const ImageTile& upper = row_.above != nullptr ? training_image_.tiles[upper_ + size_t(x)] : kBlackTile;
    const ImageTile& lower = row_.below != nullptr ? training_image_.tiles[lower_ + size_t(x)] : kBlackTile;
    for (int i = 0; i < kSpan; ++i) {
      const int at = i + kTileSide / 2 - kRadius;
      store(out + i * kTileSide,
            at < kTileSide ? colour_row(upper, channel, at) : colour_row(lower, channel, at - kTileSide));
    }
  }

  // Whether one of the two tiles has rendered blocks.
  GAUSSLITE_INLINE bool rendered(const Workspace& ws, int x) const {
    return (row_.above != nullptr && ws.needed_blocks[upper_ + size_t(x)] != 0) ||
           (row_.below != nullptr && ws.needed_blocks[lower_ + size_t(x)] != 0);
  }

  // The weights of a square, by columns: in `scratch`, or the shared array if they are constant.
  const float* weights(int x, float* scratch) const {
    const float* upper = row_.above != nullptr ? training_image_.tile_weights(upper_ + size_t(x)) : kZeroSquares;
    const float* lower = row_.below != nullptr ? training_image_.tile_weights(lower_ + size_t(x)) : kZeroSquares;
    if (upper == lower) return upper;
    Pack16 rows[kTileSide];
    for (int i = 0; i < kTileSide / 2; ++i) {
      rows[i] = load(upper + (i + kTileSide / 2) * kTileSide);
      rows[i + kTileSide / 2] = load(lower + i * kTileSide);
    }
    transpose(rows);
    for (int i = 0; i < kTileSide; ++i) store(scratch + i * kTileSide, rows[i]);
    return scratch;
  }

 private:
  const TrainingImage& training_image_;
  const SsimSquareRow& row_;
  size_t upper_, lower_;  // first tile of the tile rows
};

template <class Get>
GAUSSLITE_INLINE void blur_and_transpose(Get get, float* out) {
  Pack16 rows[kTileSide];
  blur(get, [&](int i, Pack16 sum) { rows[i] = sum; });
  transpose(rows);
  for (int i = 0; i < kTileSide; ++i) store(out + i * kTileSide, rows[i]);
}

// First of the four blurs. `rendered`: whether a block of the square is rendered; if not, the image and its blurs are
// zero.
void blur_down(const Squares& squares, int x, int channel, bool rendered, Columns& columns) {
  alignas(64) float image[kSpan * kTileSide], target[kSpan * kTileSide];
  squares.training_rows(x, channel, target);
  const auto Y = [&](int i) { return load(target + i * kTileSide); };
  if (!rendered) {
    for (const int k : {0, 3}) std::fill_n(columns.blurred(k, x), kTilePixels, 0.0f);
    blur_and_transpose(Y, columns.blurred(1, x));
    blur_and_transpose([&](int i) { return Y(i) * Y(i); }, columns.blurred(2, x));
    return;
  }
  squares.rendered_rows(x, channel, image);
  const auto X = [&](int i) { return load(image + i * kTileSide); };
  blur_and_transpose(X, columns.blurred(0, x));
  blur_and_transpose(Y, columns.blurred(1, x));
  blur_and_transpose([&](int i) { return fma(X(i), X(i), Y(i) * Y(i)); }, columns.blurred(2, x));
  blur_and_transpose([&](int i) { return X(i) * Y(i); }, columns.blurred(3, x));
}

// Column i of a square, or of its left or right neighbour for i outside 0 ... 15.
GAUSSLITE_INLINE Pack16 column(const float* columns, int i) { return load(columns + (i - kRadius) * kTileSide); }

// Computes SSIM and its derivatives in one square. Returns its loss: the sum of SSIM times -weight.
double derive(Columns& columns, int x, const float* weights, float scale) {
  Pack16 mean[kMeans][kTileSide];
  for (int k = 0; k < kMeans; ++k) {
    const float* in = columns.blurred(k, x);
    blur([&](int i) { return column(in, i); }, [&](int i, Pack16 sum) { mean[k][i] = sum; });
  }
  float* d_maps[kSsimMaps] = {columns.derivative(0, x), columns.derivative(1, x), columns.derivative(2, x)};
  Pack16 total(0.0f);
  for (int i = 0; i < kTileSide; ++i) {
    const Pack16 Ex = mean[0][i], Ey = mean[1][i], squares = mean[2][i], Exy = mean[3][i];
    const Pack16 pixel_weight = load(weights + i * kTileSide), weight = pixel_weight * -scale;
    const Pack16 cross = Ex * Ey, means = fma(Ex, Ex, Ey * Ey);
    const Pack16 A1 = fma(cross, Pack16(2.0f), Pack16(kC1)), A2 = fma(Exy - cross, Pack16(2.0f), Pack16(kC2));
    const Pack16 B1 = means + kC1, B2 = (squares - means) + kC2;
    const Pack16 inverse = Pack16(1.0f) / (B1 * B2), S = A1 * A2 * inverse, scaled = weight * inverse;
    const Pack16 d_A1 = A2 * scaled, d_A2 = A1 * scaled, d_B1 = -(S * B2 * scaled), d_B2 = -(S * B1 * scaled);
    const Pack16 d_Ex = fma(Ey, d_A1 - d_A2, Ex * (d_B1 - d_B2));
    // Pixels without a weight have no loss. Their windows may contain pixels that are not rendered.
    const Mask16 has_weight = pixel_weight > Pack16(0.0f);
    total = total + zero_unless(has_weight, S * weight);
    store(d_maps[0] + i * kTileSide, zero_unless(has_weight, d_Ex + d_Ex));
    store(d_maps[1] + i * kTileSide, zero_unless(has_weight, d_B2));
    store(d_maps[2] + i * kTileSide, zero_unless(has_weight, d_A2 + d_A2));
  }
  return double(sum(total));
}

}  // namespace

void compute_ssim(Workspace& ws, const TrainingArguments& training, const SsimSquareRow& row, int thread) {
  const uint8_t* status = training.image.square_status + size_t(row.k) * size_t(ws.tiles_x);
  double& loss = training.ssim_sums[row.k] = 0.0;
  if (!std::any_of(status, status + ws.tiles_x, [](uint8_t r) { return r == kWeighted; })) return;
  const Squares squares(ws, training.image, row);
  Columns columns(ws.scratch[size_t(thread)].ssim, ws.tiles_x);
  for (int channel = 0; channel < 3; ++channel) {
    // A pipeline over the squares. Square x is blurred down the image. In square x - 1 SSIM and its derivatives are
    // computed. The derivatives of square x - 2 are blurred along the rows. The last two need the step before from
    // their right neighbour.
    for (int x = 0; x < ws.tiles_x + 2; ++x) {
      if (x < ws.tiles_x && status[x] != kUnused) blur_down(squares, x, channel, squares.rendered(ws, x), columns);
      const int middle = x - 1;
      if (middle >= 0 && middle < ws.tiles_x) {
        if (status[middle] == kWeighted) {
          alignas(64) float scratch[kTilePixels];
          loss += derive(columns, middle, squares.weights(middle, scratch), training.loss.ssim);
        } else {
          for (int m = 0; m < kSsimMaps; ++m) std::fill_n(columns.derivative(m, middle), kTilePixels, 0.0f);
        }
      }
      const int last = x - 2;
      // Without rendered blocks there is no gradient.
      if (last >= 0 && status[last] != kUnused && squares.rendered(ws, last)) {
        for (int m = 0; m < kSsimMaps; ++m) {
          const float* in = columns.derivative(m, last);
          blur_and_transpose([&](int i) { return column(in, i); }, row.squares + ssim_map_offset(last, channel, m));
        }
      }
    }
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
