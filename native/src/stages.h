// SPDX-License-Identifier: Apache-2.0
// The stages of an iteration, as one table of functions per instruction set. All threads of the pool call each stage
// with their number; the caller entries the barriers.
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

// Whether a square of the SSIM loss has a weight, has one in reach of its windows, or neither.
enum Reach : uint8_t { kUnreached, kReached, kWeighted };

// A tile of a training image: sixteen rows of sixteen pixels per channel.
struct alignas(64) TargetTile {
  uint8_t rgb[3][kSquare];
  float depth_m[kSquare];  // 0: no measurement
};

// The targets of one training image, by tiles.
struct Targets {
  const TargetTile* tiles;
  const float* weights;  // [weight_entries[tile]][16][16]; 0 outside the image
  const uint32_t* weight_entries;
  const uint16_t* weighted_blocks;  // blocks with a weighted pixel
  const uint16_t* reached_blocks;   // blocks with a weighted pixel in reach of an SSIM window
  const uint8_t* reach;             // Reach [k][x] of the squares of loss_ssim.cpp, k = 0 ... tile rows

  // All tiles of weight 0 share one array, as do all tiles of weight 1.
  const float* tile_weights(size_t tile) const { return weights + size_t(weight_entries[tile]) * kSquare; }
};

struct LossSettings {
  float colour, depth, ssim;  // per pixel and channel, divided by the sum of the weights
};

struct Training {
  Targets targets;
  LossSettings loss;
  double* l1_sums;    // one per tile
  double* ssim_sums;  // one per row of squares
};

struct Update {
  float* rows;
  float* first_moment;
  float* second_moment;
  const uint8_t* trainable;   // null: all
  uint32_t* update_counts;    // incremented for each changed row that count_mask selects; null: no counts
  const uint8_t* count_mask;  // null: all
  AdamSettings adam;
};

struct GradientOutput {
  float* d_rows;        // zeroed by the caller
  float* mean_2d_norm;  // by visible splat
  double* d_twist;      // [segments][6], zeroed by the caller
};

// Input and output of the SSIM stage for one row of squares.
struct SquareRow {
  int k;
  const TileRowReplay *above, *below;  // of the tile rows k - 1 and k; null beyond the image
  float* squares;
};

// A rendered tile row: its replay buffer, and the rows of squares of its SSIM gradient.
struct ReplayedTileRow {
  int tile_row;
  const TileRowReplay& replay;
  const float *upper_squares, *lower_squares;
};

struct Stages {
  // Projects the segments, packs the visible splats and adds their depth keys to the tile rows that they touch.
  void (*project)(Workspace&, int thread);
  // Sorts, bins and renders a tile row into Workspace::image.
  void (*render_tile_row)(Workspace&, int tile_row, int thread);
  // Sorts, bins, renders, compares by L1 and runs the backward pass, tile by tile, with all data in cache.
  void (*train_tile_row)(Workspace&, const Training&, int tile_row, int thread);
  // With SSIM, which needs the pixels around a tile, training has three parts. This one renders a tile row into its
  // replay buffer.
  void (*render_to_replay)(Workspace&, const Training&, TileRowReplay&, int tile_row, int thread);
  // Computes SSIM and its derivatives in row k of the squares, from the rendered tile rows k - 1 and k.
  void (*derive_ssim)(Workspace&, const Training&, const SquareRow&, int thread);
  // Compares a rendered tile row and runs its backward pass; needs rows `tile_row` and `tile_row` + 1 of the squares.
  void (*backward_from_replay)(Workspace&, const Training&, const ReplayedTileRow&);
  // Backward pass from image_gradient to gradient rows, for a tile row that render_tile_row rendered.
  void (*backward_tile_row)(Workspace&, int tile_row, int thread);
  // Adam step from gradient rows, a thread's own segments first.
  void (*update)(Workspace&, const Update&, int thread);
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
