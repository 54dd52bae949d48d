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

// The targets of one training image, planar and padded like Workspace::image.
struct Targets {
  const float* rgb;      // three planes
  const float* depth_m;  // 0 where there is no measurement
  const float* weight;   // 0 outside the image
  const float* moments;  // SSIM: three planes of the mean, three of the mean square; null when SSIM was not prepared
  const uint8_t* weighted_tiles;  // 1 where a tile has a pixel with a weight
  const uint16_t* spans;          // per image row: first column with a weight, end column; equal where there is none
};

struct LossSettings {
  float colour, depth, ssim;  // per pixel and channel: already divided by the sum of the weights
};

struct Training {
  Targets targets;
  LossSettings loss;
  double* loss_sums;  // fused: one per tile; otherwise one per image row
};

struct Update {
  float* rows;
  float* first_moment;
  float* second_moment;
  const uint8_t* trainable;  // null: all
  AdamSettings adam;
};

struct GradientOutput {
  float* d_rows;        // zeroed by the caller
  float* mean_2d_norm;  // by visible splat
  double* d_twist;      // [segments][6]
};

struct Stages {
  // Projects this thread's segments, packs the visible splats and hands their depth keys to the tile rows that they
  // touch.
  void (*project)(Workspace&, int thread);
  // Sorts, bins and draws a tile row into Workspace::image.
  void (*draw_strip)(Workspace&, int strip, int thread);
  // Sorts, bins, draws, compares with L1 and walks back, tile by tile while everything is in cache.
  void (*train_strip)(Workspace&, const Training&, int strip, int thread);
  // The colour and depth terms on image rows [begin, end): writes Workspace::image_gradient.
  void (*loss_l1)(Workspace&, const Training&, int begin, int end);
  // Adds the SSIM term on image rows [begin, end) after loss_l1 has written them.
  void (*loss_ssim)(Workspace&, const Training&, int begin, int end, int thread);
  // From image_gradient to gradient rows, for the tile row that draw_strip has drawn.
  void (*backward_strip)(Workspace&, int strip, int thread);
  // From gradient rows to parameters, over this thread's segments.
  void (*update)(Workspace&, const Update&, int thread);
  void (*gradients)(Workspace&, const GradientOutput&, int thread);
  // The blurred target and its blurred square, once per training image.
  void (*prepare_ssim)(const float* rgb, int width, int height, int padded_width, int64_t plane, float* moments,
                       float* scratch);
  size_t (*ssim_scratch_floats)(int padded_width);
};

namespace portable {
const Stages& stages();
}
#if defined(GAUSSLITE_X86_FORMS)
namespace avx2 {
const Stages& stages();
}
namespace avx512 {
const Stages& stages();
}
#endif

}  // namespace gausslite
