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
  const float* corrections;  // 1 / (1 - beta^t) for beta1 and beta2 in turn, t = 1 ... correction_count
  int correction_count;
};

// What the weights make of a square of the SSIM loss: without a weight in it or beside it, nothing is blurred there.
enum Reach : uint8_t { kUnreached, kReached, kWeighted };

// By rows k = 0 ... tile rows of the squares that loss_ssim.cpp describes; within a square by columns.
struct SsimTargets {
  const float* moments;  // [row][channel][square][mean, mean square][16][16]
  const float* weights;  // [row][square][16][16]
  const uint8_t* reach;  // [row][square]
};

constexpr int kTargets = 4;

// The targets of one training image, by tiles.
struct Targets {
  const float* tiles;               // [tile][red, green, blue, depth in metres or 0][16][16]
  const float* weights;             // [tile][16][16]; 0 outside the image
  const uint16_t* weighted_blocks;  // by tile: the blocks that have a pixel with a weight
  const uint16_t* reached_blocks;   // ... and those that have one in an SSIM window around it
  SsimTargets ssim;
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
  double* d_twist;      // [segments][6]
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
  // Projects this thread's segments, packs the visible splats and hands their depth keys to the tile rows that they
  // touch.
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
  // From gradient rows to parameters, over this thread's segments.
  void (*update)(Workspace&, const Update&, int thread);
  void (*gradients)(Workspace&, const GradientOutput&, int thread);
  // The blurred target and its blurred square (SsimTargets::moments), once per training image.
  void (*prepare_ssim)(const float* target_tiles, int tiles_x, int tiles_y, float* moments, float* scratch);
  size_t (*ssim_scratch_floats)(int tiles_x);
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
