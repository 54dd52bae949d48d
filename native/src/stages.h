// SPDX-License-Identifier: Apache-2.0
// The stages of an iteration, as one table of functions per instruction set.
//
// Terms of the kernels:
// - tile: 16x16 pixels. tile row: the tiles at one height of the image.
// - block: 4x4 pixels, 16 per tile. A block mask has the bit 4 row + column for each block of a tile.
// - SSIM square: 16x16 pixels, half a tile higher than a tile (workspace.h). There is one row of squares more than tile
//   rows.
// - segment: kSegmentRows (workspace.h) successive parameter rows, processed by one thread. Its own segments are those
//   that a thread takes first, the same ones in each stage.
// - slot: index of a visible splat in Workspace::splats. The slots of segment s start at s * kSegmentRows.
// - forward cache: what the backward pass reuses of the forward pass of a tile row (TileRowCache).
//
// The caller is Rasterizer. In `project`, `update` and `gradients`, all threads of the pool take segments, with
// barriers between these stages. The stages that process one tile row are tasks: threads take tile rows in any order,
// and steps with SSIM in the order of TileRowSchedule.
#pragma once

#include <cstddef>
#include <cstdint>

#include "workspace.h"

namespace gausslite {

// Settings of Adam. step_factors holds the two factors of a step by the number of updates (AdamCorrections::table).
struct AdamSettings {
  float rates[16];
  float beta1, beta2, epsilon;
  const float* step_factors;
  int step_factor_count;
};

// Use of an SSIM square by the loss. kWeighted: it has pixels with a weight, for which SSIM is computed.
// kWindowInput: it has none, but windows of an adjacent kWeighted square reach into it. kUnused: neither.
enum SquareStatus : uint8_t { kUnused, kWindowInput, kWeighted };

// A tile of the image that a view is compared with: sixteen rows of sixteen pixels per channel.
struct alignas(64) ImageTile {
  uint8_t rgb[3][kTilePixels];
  float depth_m[kTilePixels];  // 0: no measurement
};

// The image that a view is compared with, and the weights of its pixels in the loss. The arrays belong to TrainingView.
struct TrainingImage {
  const ImageTile* tiles;
  const float* weights;                  // arrays of 16x16 pixel weights, 0 outside the image
  const uint32_t* weight_array_of_tile;  // [tile]: number of its array in `weights`
  const uint16_t* weighted_blocks;       // [tile]: mask of the blocks with a weighted pixel
  const uint16_t* reached_blocks;        // [tile]: mask of the blocks in the SSIM window of a weighted pixel
  const uint8_t* square_status;          // [k][x]: SquareStatus of SSIM square x in row k, k = 0 ... tile rows

  // All tiles of weight 0 share one array, as do all tiles of weight 1.
  const float* tile_weights(size_t tile) const { return weights + size_t(weight_array_of_tile[tile]) * kTilePixels; }
};

// Factors of a pixel's loss terms: the loss weights divided by the sum of the pixel weights, or by the number of pixels
// with LossWeights::normalise_by_image; and divided by 3 for the channels of colour and SSIM.
struct LossSettings {
  float colour, depth, ssim;
};

// Input and output of the loss stages.
struct TrainingArguments {
  TrainingImage image;
  LossSettings loss;
  double* l1_sums;    // one per tile
  double* ssim_sums;  // one per row of SSIM squares
};

// Tables and settings of the update stage.
struct UpdateArguments {
  float* rows;
  float* first_moment;
  float* second_moment;
  uint32_t* update_counts;    // incremented for each changed row that count_mask selects; null: no counts
  const uint8_t* count_mask;  // null: all
  AdamSettings adam;
};

// Output of the gradient stage.
struct GradientOutput {
  float* d_rows;             // zeroed by the caller
  float* mean_2d_grad_norm;  // [slot]: norm of the gradient of its 2D mean
  double* d_twist;           // [segment][6]: gradient of the camera twist, zeroed by the caller
};

// Input and output of the SSIM stage for one row of SSIM squares.
struct SsimSquareRow {
  int k;
  const TileRowCache *above, *below;  // forward caches of the tile rows k - 1 and k; null beyond the image
  float* squares;
};

// Input of the backward stage with SSIM: a tile row, its forward cache, and the rows of SSIM squares that it overlaps.
struct RenderedTileRow {
  int index;
  const TileRowCache& cache;
  const float *upper_squares, *lower_squares;
};

struct Stages {
  // Projects the segments (kSegmentRows parameter rows each), packs the visible splats, and adds their depth keys to
  // the tile rows that they touch.
  void (*project)(Workspace&, int thread);
  // Sorts, bins and renders a tile row into Workspace::image.
  void (*render_tile_row)(Workspace&, int tile_row, int thread);
  // Sorts and bins a tile row. Then renders each tile, computes its L1 loss and runs its backward pass, with all data
  // in cache.
  void (*train_tile_row)(Workspace&, const TrainingArguments&, int tile_row, int thread);
  // SSIM needs the pixels around a tile. So training with SSIM has three stages: render_to_cache, compute_ssim and
  // backward_from_cache. This one renders a tile row into its forward cache.
  void (*render_to_cache)(Workspace&, const TrainingArguments&, TileRowCache&, int tile_row, int thread);
  // Computes SSIM and its derivatives in row k of the SSIM squares, from the rendered tile rows k - 1 and k.
  void (*compute_ssim)(Workspace&, const TrainingArguments&, const SsimSquareRow&, int thread);
  // Computes the L1 loss of a rendered tile row and runs its backward pass. Tile row s needs the rows s and s + 1 of
  // the SSIM squares.
  void (*backward_from_cache)(Workspace&, const TrainingArguments&, const RenderedTileRow&);
  // Backward pass from image_gradient to gradient rows, for a tile row that render_tile_row rendered.
  void (*backward_tile_row)(Workspace&, int tile_row, int thread);
  // Converts gradient rows to parameter gradients and applies an Adam step, a thread's own segments first.
  void (*update)(Workspace&, const UpdateArguments&, int thread);
  // Converts gradient rows to parameter gradients and writes them out.
  void (*gradients)(Workspace&, const GradientOutput&, int thread);
};

// The SIMD variants; dispatch.cpp uses those of this build.
namespace portable {
const Stages& stages();
}
namespace avx2 {
const Stages& stages();
}
namespace avx512 {
const Stages& stages();
}
namespace neon {
const Stages& stages();
}

}  // namespace gausslite
