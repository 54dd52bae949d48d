// SPDX-License-Identifier: Apache-2.0
// The order of the stages: forward, backward, and the whole training step in one call.
#pragma once

#include <utility>
#include <vector>

#include "adam_corrections.h"
#include "image_exchange.h"
#include "stages.h"
#include "strip_schedule.h"
#include "team.h"
#include "training_view.h"

namespace gausslite {

// A frame to draw. Nothing is owned.
struct FrameInput {
  const float* rows;
  uint32_t row_count;
  const uint32_t* ids;  // null: all rows
  uint32_t id_count;
  const uint8_t* active_tiles;  // null: all tiles
  Camera camera;
};

struct LossWeights {
  float colour, depth, ssim;
  bool normalise_by_image;  // the loss times the view's share: a pixel of weight 1 then counts the same in every step
};

struct OptimizerState {
  float* rows;
  float* first_moment;
  float* second_moment;
  const uint8_t* trainable;  // null: all
  uint32_t* trained;         // as in Update
  const uint8_t* counted;
  uint64_t loan;  // numbers a time in which these rows change by steps alone; 0: others may change them in between
};

struct AdamOptions {
  float rates[16];
  double beta1, beta2, epsilon, decay_after_updates;
};

// Milliseconds of the last call's stages, as its first thread saw them. With SSIM strips are drawn, compared and walked
// back side by side: then raster, loss and backward are the times that it spent on each.
struct StageTimes {
  double project = 0.0, raster = 0.0, loss = 0.0, backward = 0.0, update = 0.0;
};

// One call at a time: whoever owns it sees to that. A call that throws (memory that cannot be had) leaves it usable.
class Rasterizer {
 public:
  Rasterizer(const Stages& stages, int threads);

  int threads() const { return team_.size(); }
  const StageTimes& times() const { return times_; }
  // What all steps took so far, and those masked to a region.
  double steps_ms() const { return steps_ms_; }
  double masked_steps_ms() const { return masked_steps_ms_; }
  // How often the last frame composited a splat on a 4x4 block of pixels.
  uint64_t block_evaluations() const;
  // True when the last frame had this many rows and pixels.
  bool matches(size_t rows, size_t width, size_t height) const {
    return rows == row_count_ && width == size_t(ws_.camera.width) && height == size_t(ws_.camera.height);
  }
  // Rises with every forward and step: a rendering of an earlier frame cannot be walked back.
  uint64_t frame() const { return frame_; }

  void forward(const FrameInput& input, const ImageOutput& output);
  // Of the last forward. d_rows must be zero; mean_2d_norm has room for visible_count().
  void backward(const ImageGradients& input, float* d_rows, double* d_twist, float* mean_2d_norm);
  double step(const FrameInput& input, const OptimizerState& state, const TrainingView& view, bool masked,
              const LossWeights& loss, const AdamOptions& adam);

  // The rows that the last call found visible, ascending.
  uint32_t visible_count() const;
  void copy_visible(uint32_t* ids) const;

 private:
  void begin_frame(const FrameInput& input);
  void want_blocks(const uint16_t* blocks);
  Training begin_training(const TrainingView& view, bool masked, const LossWeights& loss);
  void train_with_ssim(const Training& training, int thread);
  void next_tag();
  void use_bounds(uint64_t loan);
  void order_strips();
  void schedule_strips();
  uint32_t keys_of_strip(int y) const;
  void prepare_gradient_rows();
  void mark(double StageTimes::*stage);
  template <class F>
  void for_each_strip(F f);

  const Stages& stages_;
  Team team_;
  Workspace ws_;
  uint64_t frame_ = 0;
  uint32_t row_count_ = 0;
  StripSchedule schedule_;
  std::vector<std::pair<uint32_t, int>> strip_order_;  // keys and tile row, most keys first
  std::vector<uint32_t> strip_weights_;
  uint64_t bounds_loan_ = 0;  // the loan in which the bounds are true
  Buffer<double> l1_sums_, ssim_sums_, twist_sums_;
  Buffer<float> norms_by_slot_;
  AdamCorrections corrections_;
  StageTimes times_;
  double last_mark_ms_ = 0.0;
  double steps_ms_ = 0.0, masked_steps_ms_ = 0.0;
};

}  // namespace gausslite
