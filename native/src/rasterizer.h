// SPDX-License-Identifier: Apache-2.0
// Runs the stages in order: forward, backward, and a whole training step in one call.
#pragma once

#include <utility>
#include <vector>

#include "adam_corrections.h"
#include "image_exchange.h"
#include "stages.h"
#include "thread_pool.h"
#include "tile_row_schedule.h"
#include "training_view.h"

namespace gausslite {

// A frame to render. It owns none of its arrays.
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
  bool normalise_by_image;  // multiplies the loss by the mean pixel weight of the view
};

struct OptimizerState {
  float* rows;
  float* first_moment;
  float* second_moment;
  uint32_t* update_counts;   // as in UpdateArguments
  const uint8_t* count_mask;
  // Number of the table binding: only steps change the rows of bound tables. 0: not bound, other code may change them.
  uint64_t binding_id;
};

struct AdamOptions {
  float rates[16];
  double beta1, beta2, epsilon, decay_after_updates;
};

// Milliseconds of each stage of the last call, measured on thread 0. A step without SSIM renders, compares and runs the
// backward pass tile by tile: `render` is the time of all three. With SSIM the render, loss and backward tasks of
// different tile rows alternate: their times are sums over the thread's tasks.
struct StageTimes {
  double project = 0.0, render = 0.0, loss = 0.0, backward = 0.0, update = 0.0;
};

// The owner makes one call at a time. The object stays usable after a call that throws (std::bad_alloc).
class Rasterizer {
 public:
  Rasterizer(const Stages& stages, int threads);

  int threads() const { return pool_.size(); }
  const StageTimes& times() const { return times_; }
  // Total time of all steps, and of the masked ones.
  double steps_ms() const { return steps_ms_; }
  double masked_steps_ms() const { return masked_steps_ms_; }
  // Number of pairs of a splat and a 4x4 pixel block that the last frame composited.
  uint64_t block_evaluations() const;
  // True if the last frame had this many rows and pixels.
  bool matches(size_t rows, size_t width, size_t height) const {
    return rows == row_count_ && width == size_t(ws_.camera.width) && height == size_t(ws_.camera.height);
  }
  // Number of the latest forward or step. backward needs the latest frame.
  uint64_t frame() const { return frame_; }

  void forward(const FrameInput& input, const ImageOutput& output);
  // Gradients of the last forward. d_rows must be zero; mean_2d_grad_norm has visible_count() elements.
  void backward(const ImageGradients& input, float* d_rows, double* d_twist, float* mean_2d_grad_norm);
  double step(const FrameInput& input, const OptimizerState& state, const TrainingView& view, bool masked,
              const LossWeights& loss, const AdamOptions& adam);

  // The visible rows of the last call, ascending.
  uint32_t visible_count() const;
  void copy_visible(uint32_t* ids) const;

 private:
  void begin_frame(const FrameInput& input);
  void select_blocks(const uint16_t* blocks);
  TrainingArguments begin_training(const TrainingView& view, bool masked, const LossWeights& loss);
  void train_with_ssim(const TrainingArguments& training, int thread);
  void start_gradient_pass();
  void select_bounds(uint64_t binding_id);
  void order_tile_rows();
  void schedule_tile_rows();
  uint32_t tile_row_keys(int y) const;
  void prepare_gradient_rows();
  void record_stage(double StageTimes::* stage);
  template <class F>
  void for_each_tile_row(F f);

  const Stages& stages_;
  ThreadPool pool_;
  Workspace ws_;
  uint64_t frame_ = 0;
  uint32_t row_count_ = 0;
  TileRowSchedule schedule_;
  std::vector<std::pair<uint32_t, int>> tile_row_order_;  // number of depth keys and tile row, most keys first
  std::vector<uint32_t> tile_row_key_counts_;             // [tile row]: number of depth keys
  uint64_t bounds_binding_id_ = 0;                        // the binding for which the bounds are valid
  Buffer<double> l1_sums_, ssim_sums_, twist_sums_;
  Buffer<float> mean_2d_grad_norms_;  // [slot of the visible splat]
  AdamCorrections corrections_;
  StageTimes times_;
  double stage_start_ms_ = 0.0;
  double steps_ms_ = 0.0, masked_steps_ms_ = 0.0;
};

}  // namespace gausslite
