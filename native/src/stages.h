// SPDX-License-Identifier: Apache-2.0
// The stages of an iteration, as one table of functions per instruction set. All threads of the pool call each stage
// with their index. The caller synchronises them with barriers between the stages.
#pragma once

#include <cstddef>
#include <cstdint>

#include "workspace.h"

namespace gausslite {

struct AdamSettings {
  float rates[16];
  float beta1, beta2, epsilon;
  const float* corrections;  // AdamCorrections::table
  int correction_count;
};

// Use of an SSIM square (workspace.h) by the loss. kWeighted: it has pixels with a weight, for which SSIM is computed.
// kWindowInput: it has none, but windows of an adjacent kWeighted square reach into it. kUnused: neither.
enum SquareStatus : uint8_t { kUnused, kWindowInput, kWeighted };

// A tile of a training image: sixteen rows of sixteen pixels per channel.
struct alignas(64) TargetTile {
  uint8_t rgb[3][kTilePixels];
  float depth_m[kTilePixels];  // 0: no measurement
};

// The targets of one training image, by tiles.
struct Targets {
  const TargetTile* tiles;
  const float* weights;                  // arrays of 16x16 pixels, 0 outside the image
  const uint32_t* weight_entry_of_tile;  // [tile]: index of its array in `weights`
  const uint16_t* weighted_blocks;       // [tile]: mask of the blocks with a weighted pixel
  const uint16_t* reached_blocks;        // [tile]: mask of the blocks in the SSIM window of a weighted pixel
  const uint8_t* square_status;          // [k][x]: SquareStatus of SSIM square x in row k, k = 0 ... tile rows

  // All tiles of weight 0 share one array, as do all tiles of weight 1.
  const float* tile_weights(size_t tile) const { return weights + size_t(weight_entry_of_tile[tile]) * kTilePixels; }
};

// Factors of a pixel's loss terms: the loss weights, divided by the sum of the pixel weights, and by 3 for the channels
// of colour and SSIM.
struct LossSettings {
  float colour, depth, ssim;
};

// Input and output of the loss stages.
struct TrainingArguments {
  Targets targets;
  LossSettings loss;
  double* l1_sums;    // one per tile
  double* ssim_sums;  // one per row of SSIM squares
};

// Tables and settings of the update stage.
struct UpdateArguments {
  float* rows;
  float* first_moment;
  float* second_moment;
  const uint8_t* trainable;   // null: all
  uint32_t* update_counts;    // incremented for each changed row that count_mask selects; null: no counts
  const uint8_t* count_mask;  // null: all
  AdamSettings adam;
};

// Output of the gradient stage.
struct GradientOutput {
  float* d_rows;             // zeroed by the caller
  float* mean_2d_grad_norm;  // [slot of the visible splat]: norm of the gradient of its 2D mean
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
