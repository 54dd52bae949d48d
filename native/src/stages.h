// SPDX-License-Identifier: Apache-2.0
// The stages of an iteration, as one table of functions per instruction set. Each stage is called by every thread of
// the team with its own number; the barriers between stages are the caller's.
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

// What the weights make of a square of the SSIM loss: without a weight in it or beside it, nothing is blurred there.
enum Reach : uint8_t { kUnreached, kReached, kWeighted };

// A tile of a training image, sixteen rows of sixteen pixels of each.
struct alignas(64) TargetTile {
  uint8_t rgb[3][kSquare];
  float depth_m[kSquare];  // 0: not measured
};

// The targets of one training image, by tiles.
struct Targets {
  const TargetTile* tiles;
  const float* weights;  // [place][16][16]; 0 outside the image
  const uint32_t* weight_places;
  const uint16_t* weighted_blocks;  // the blocks that have a pixel with a weight
  const uint16_t* reached_blocks;   // ... and those that have one in an SSIM window around it
  const uint8_t* reach;             // [row][square] for rows k = 0 ... tile rows of the squares of loss_ssim.cpp

  // Tiles that weigh the same everywhere, all 0 or all 1, share theirs.
  const float* tile_weights(size_t tile) const { return weights + size_t(weight_places[tile]) * kSquare; }
};

struct LossSettings {
  float colour, depth, ssim;  // per pixel and channel: already divided by the sum of the weights
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
  const uint8_t* trainable;  // null: all
  uint32_t* trained;         // rises by one for each row that moves and is counted; null: nobody counts
  const uint8_t* counted;    // null: all
  AdamSettings adam;
};

struct GradientOutput {
  float* d_rows;        // zeroed by the caller
  float* mean_2d_norm;  // by visible splat
  double* d_twist;      // [segments][6], zeroed by the caller
};

// What a row of SSIM squares is formed from, and where its derivatives go.
struct SquareRow {
  int k;
  const StripTape *above, *below;  // of the tile rows k - 1 and k; null beyond the image
  float* squares;
};

// A strip that can be walked back: its tape, and the rows of squares that its gradient comes from.
struct TapedStrip {
  int strip;
  const StripTape& tape;
  const float *upper_squares, *lower_squares;
};

struct Stages {
  // Projects the segments that are left to do, packs the visible splats and hands their depth keys to the tile rows
  // that they touch.
  void (*project)(Workspace&, int thread);
  // Sorts, bins and draws a tile row into Workspace::image.
  void (*draw_strip)(Workspace&, int strip, int thread);
  // Sorts, bins, draws, compares with L1 and walks back, tile by tile while everything is in cache.
  void (*train_strip)(Workspace&, const Training&, int strip, int thread);
  // The same with SSIM, which looks beyond the tile, in three parts. Draws a strip and keeps its tape.
  void (*draw_on_tape)(Workspace&, const Training&, StripTape&, int strip, int thread);
  // SSIM in row k of the squares, once tile rows k - 1 and k are drawn.
  void (*derive_ssim)(Workspace&, const Training&, const SquareRow&, int thread);
  // Compares a strip and walks it back, once rows `strip` and `strip` + 1 of the squares are derived.
  void (*walk_back_on_tape)(Workspace&, const Training&, const TapedStrip&);
  // From image_gradient to gradient rows, for the tile row that draw_strip has drawn.
  void (*backward_strip)(Workspace&, int strip, int thread);
  // From gradient rows to parameters, a thread's own segments first.
  void (*update)(Workspace&, const Update&, int thread);
  void (*gradients)(Workspace&, const GradientOutput&, int thread);
};

// The forms; dispatch.cpp refers to those that this build has.
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
