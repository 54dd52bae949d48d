// SPDX-License-Identifier: Apache-2.0
#include "rasterizer.h"

#include <algorithm>
#include <chrono>
#include <functional>

#include "row_layout.h"

namespace gausslite {

namespace {

double now_ms() {
  return std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

// Range of image rows that one thread processes.
struct Band {
  int begin, end;
  Band(int height, int thread, int threads) : begin(height * thread / threads), end(height * (thread + 1) / threads) {}
};

// Returns the mask of a tile's blocks inside an image that extends `columns` and `rows` pixels from the corner of the
// tile.
uint16_t blocks_inside(int columns, int rows) {
  const int across = std::min((columns + kBlockSide - 1) / kBlockSide, kBlocksPerSide);
  const int down = std::min((rows + kBlockSide - 1) / kBlockSide, kBlocksPerSide);
  return uint16_t(((1u << across) - 1u) * 0x1111u & ((1u << kBlocksPerSide * down) - 1u));
}

}  // namespace

Rasterizer::Rasterizer(const Stages& stages, int threads) : stages_(stages), pool_(threads) {
  ws_.threads = threads;
  ws_.scratch = std::vector<ThreadScratch>(size_t(threads));
}

void Rasterizer::begin_frame(const FrameInput& input) {
  ws_.camera = input.camera;
  ws_.tiles_x = (input.camera.width + kTileSide - 1) / kTileSide;
  ws_.tiles_y = (input.camera.height + kTileSide - 1) / kTileSide;
  ws_.padded_width = ws_.tiles_x * kTileSide;
  ws_.plane_pixels = int64_t(ws_.padded_width) * ws_.tiles_y * kTileSide;
  row_count_ = input.row_count;
  ws_.rows = input.rows;
  ws_.ids = input.ids;
  ws_.count = input.ids != nullptr ? input.id_count : input.row_count;
  ws_.active_tiles = input.active_tiles;
  ++frame_;
  start_gradient_pass();
  ws_.segments = (ws_.count + kSegmentRows - 1) / kSegmentRows;
  ws_.splats.ensure_capacity(size_t(ws_.count) + 1);
  ws_.visible.ensure_capacity(size_t(ws_.count) + 1);
  ws_.segment_visible.ensure_capacity(ws_.segments + 1);
  ws_.segment_thread.ensure_capacity(ws_.segments + 1);
  ws_.segment_keys.ensure_capacity(size_t(ws_.segments + 1) * size_t(ws_.tiles_y));
  ws_.stores_bounds = ws_.has_bounds = false;
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  ws_.gradient_rows_used = 0;
  ws_.next_tile_row = 0;
  ws_.reset_segments();
  for (ThreadScratch& scratch : ws_.scratch) {
    if (scratch.tile_rows.size() <= size_t(ws_.tiles_y)) scratch.tile_rows.resize(size_t(ws_.tiles_y) + 1);
    scratch.block_evaluations = 0;
  }
  ws_.needed_blocks.ensure_capacity(tiles + 1);
  if (input.active_tiles != nullptr) ws_.active.assign(input.active_tiles, ws_.tiles_x, ws_.tiles_y);
  times_ = {};
  stage_start_ms_ = now_ms();
}

// Sets ws_.needed_blocks: the given blocks ([tile]: mask) of the active tiles. Null: all blocks inside the image.
void Rasterizer::select_blocks(const uint16_t* blocks) {
  for (int y = 0, t = 0; y < ws_.tiles_y; ++y) {
    for (int x = 0; x < ws_.tiles_x; ++x, ++t) {
      const bool active = ws_.active_tiles == nullptr || ws_.active_tiles[t];
      const uint16_t blocks_here =
          blocks != nullptr ? blocks[t]
                            : blocks_inside(ws_.camera.width - x * kTileSide, ws_.camera.height - y * kTileSide);
      ws_.needed_blocks[size_t(t)] = active ? blocks_here : uint16_t(0);
    }
  }
}

// Numbers the pass that writes gradient rows. It skips 0: new memory is zero, and would count as written in this pass.
void Rasterizer::start_gradient_pass() {
  if (++ws_.gradient_pass == 0) ++ws_.gradient_pass;
}

// Ensures memory for the gradient rows, and for one more: the update loads two rows of each splat before it checks
// their number.
void Rasterizer::prepare_gradient_rows() {
  ws_.gradient_rows.ensure_capacity((size_t(ws_.gradient_rows_used.load()) + 1) * kRowWidth);
}

void Rasterizer::record_stage(double StageTimes::* stage) {
  const double now = now_ms();
  times_.*stage = now - std::exchange(stage_start_ms_, now);
}

// Decides if this step may use stored culling bounds, and if it stores them. Bounds exist only for bound tables, from
// the first step that projects all rows.
void Rasterizer::select_bounds(uint64_t binding_id) {
  ws_.has_bounds = binding_id != 0 && binding_id == bounds_binding_id_;
  ws_.stores_bounds = binding_id != 0 && (ws_.has_bounds || ws_.ids == nullptr);
  if (ws_.stores_bounds) ws_.bounds.ensure_capacity(size_t(row_count_) / 16 + 1);
  bounds_binding_id_ = 0;  // a step that throws leaves invalid bounds
}

// Orders the tile rows by their number of depth keys, most first, so that all threads end at nearly the same time.
void Rasterizer::order_tile_rows() {
  tile_row_order_.clear();
  for (int y = 0; y < ws_.tiles_y; ++y) tile_row_order_.emplace_back(tile_row_keys(y), y);
  std::sort(tile_row_order_.begin(), tile_row_order_.end(), std::greater<>());
}

uint32_t Rasterizer::tile_row_keys(int y) const {
  uint32_t keys = 0;
  for (const ThreadScratch& scratch : ws_.scratch) keys += scratch.tile_rows[size_t(y)].count;
  return keys;
}

// The order for steps with SSIM: each thread renders adjacent tile rows, with an equal share of the depth keys.
void Rasterizer::schedule_tile_rows() {
  tile_row_key_counts_.clear();
  for (int y = 0; y < ws_.tiles_y; ++y) tile_row_key_counts_.push_back(tile_row_keys(y));
  schedule_.start(tile_row_key_counts_, pool_.size(), TileRowSchedule::cache_slots(pool_.size()));
}

template <class F>
void Rasterizer::for_each_tile_row(F f) {
  for (int i; (i = ws_.next_tile_row.fetch_add(1, std::memory_order_relaxed)) < ws_.tiles_y;) {
    f(tile_row_order_[size_t(i)].second);
  }
}

void Rasterizer::forward(const FrameInput& input, const ImageOutput& output) {
  begin_frame(input);
  select_blocks(nullptr);
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  if (ws_.tiles.size() < tiles) ws_.tiles.resize(tiles);
  ws_.image.ensure_capacity(5 * size_t(ws_.plane_pixels));
  ws_.image_gradient.ensure_capacity(5 * size_t(ws_.plane_pixels));
  pool_.run([&](int thread) {
    stages_.project(ws_, thread);
    pool_.barrier([&] {
      order_tile_rows();
      record_stage(&StageTimes::project);
    });
    for_each_tile_row([&](int tile_row) { stages_.render_tile_row(ws_, tile_row, thread); });
    pool_.barrier([&] { record_stage(&StageTimes::render); });
    const Band band(ws_.camera.height, thread, pool_.size());
    export_image(ws_, output, band.begin, band.end);
  });
}

void Rasterizer::backward(const ImageGradients& input, float* d_rows, double* d_twist, float* mean_2d_grad_norm) {
  stage_start_ms_ = now_ms();
  ws_.next_tile_row = 0;
  ws_.reset_segments();
  start_gradient_pass();  // a second backward of the same forward must not add to the first one's rows
  prepare_gradient_rows();
  twist_sums_.ensure_capacity(6 * size_t(ws_.segments) + 6);
  std::fill_n(twist_sums_.data(), 6 * size_t(ws_.segments), 0.0);
  mean_2d_grad_norms_.ensure_capacity(size_t(ws_.count) + 1);
  const GradientOutput output{d_rows, mean_2d_grad_norms_.data(), twist_sums_.data()};
  pool_.run([&](int thread) {
    const Band band(ws_.tiles_y * kTileSide, thread, pool_.size());
    import_gradients(ws_, input, band.begin, band.end);
    pool_.barrier();
    for_each_tile_row([&](int tile_row) { stages_.backward_tile_row(ws_, tile_row, thread); });
    pool_.barrier([&] { record_stage(&StageTimes::backward); });
    stages_.gradients(ws_, output, thread);
    pool_.barrier([&] { record_stage(&StageTimes::update); });
  });
  std::fill_n(d_twist, 6, 0.0);
  for (uint32_t s = 0; s < ws_.segments; ++s) {
    for (size_t k = 0; k < 6; ++k) d_twist[k] += twist_sums_[6 * size_t(s) + k];
    const float* norms = mean_2d_grad_norms_.data() + size_t(s) * kSegmentRows;
    mean_2d_grad_norm = std::copy_n(norms, ws_.segment_visible[s], mean_2d_grad_norm);
  }
}

TrainingArguments Rasterizer::begin_training(const TrainingView& view, bool masked, const LossWeights& loss) {
  const double weight_sum = view.weight_sum(masked), scale = loss.normalise_by_image ? view.mean_weight(masked) : 1.0;
  const double per_pixel = weight_sum > 0.0 ? scale / weight_sum : 0.0;
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  for (ThreadScratch& scratch : ws_.scratch) {
    if (scratch.tiles.size() < size_t(ws_.tiles_x)) scratch.tiles.resize(size_t(ws_.tiles_x));
  }
  l1_sums_.ensure_capacity(tiles);
  ssim_sums_.ensure_capacity(size_t(ws_.tiles_y) + 1);
  const TrainingArguments training{
      view.image(masked),
      {float(loss.colour * per_pixel / 3.0), float(loss.depth * per_pixel), float(loss.ssim * per_pixel / 3.0)},
      l1_sums_.data(),
      ssim_sums_.data()};
  if (loss.ssim == 0.0f) {
    select_blocks(training.image.weighted_blocks);
  } else {
    select_blocks(training.image.reached_blocks);
    const int caches = TileRowSchedule::cache_slots(pool_.size());
    const size_t rows = size_t(TileRowSchedule::square_slots(caches));
    if (ws_.caches.size() < size_t(caches)) ws_.caches.resize(size_t(caches));
    if (ws_.ssim_squares.size() < rows) ws_.ssim_squares.resize(rows);
    for (Buffer<float>& squares : ws_.ssim_squares) squares.ensure_capacity(ssim_map_offset(ws_.tiles_x, 0, 0));
  }
  return training;
}

void Rasterizer::train_with_ssim(const TrainingArguments& training, int thread) {
  StageTimes stage_ms;
  double started_ms = now_ms();
  for (TileRowTask task; (task = schedule_.next(thread)).kind != TileRowTask::kNone;) {
    const auto cache = [&](int i) { return task.caches[i] >= 0 ? &ws_.caches[size_t(task.caches[i])] : nullptr; };
    const auto squares = [&](int i) { return ws_.ssim_squares[size_t(task.squares[i])].data(); };
    double StageTimes::* stage = &StageTimes::render;
    if (task.kind == TileRowTask::kRender) {
      stages_.render_to_cache(ws_, training, *cache(0), task.index, thread);
    } else if (task.kind == TileRowTask::kSsim) {
      stages_.compute_ssim(ws_, training, {task.index, cache(0), cache(1), squares(0)}, thread);
      stage = &StageTimes::loss;
    } else {
      stages_.backward_from_cache(ws_, training, {task.index, *cache(0), squares(0), squares(1)});
      stage = &StageTimes::backward;
    }
    schedule_.finish(task);
    const double now = now_ms();
    stage_ms.*stage += now - std::exchange(started_ms, now);
  }
  stage_ms.backward += now_ms() - started_ms;  // includes the wait for the last tile rows, which other threads process
  if (thread == 0) {
    times_.render = stage_ms.render;
    times_.loss = stage_ms.loss;
    times_.backward = stage_ms.backward;
  }
}

double Rasterizer::step(const FrameInput& input, const OptimizerState& state, const TrainingView& view, bool masked,
                        const LossWeights& loss, const AdamOptions& adam) {
  const double started_ms = now_ms();
  begin_frame(input);
  select_bounds(state.binding_id);
  const TrainingArguments training = begin_training(view, masked, loss);
  const bool with_ssim = loss.ssim != 0.0f;
  UpdateArguments update{
      state.rows, state.first_moment, state.second_moment, state.update_counts, state.count_mask, {}};
  std::copy_n(adam.rates, 16, update.adam.rates);
  update.adam.beta1 = float(adam.beta1);
  update.adam.beta2 = float(adam.beta2);
  update.adam.epsilon = float(adam.epsilon);
  update.adam.step_factors = corrections_.table(adam.beta1, adam.beta2, adam.decay_after_updates);
  update.adam.step_factor_count = AdamCorrections::kCount;

  pool_.run([&](int thread) {
    stages_.project(ws_, thread);
    pool_.barrier([&] {
      prepare_gradient_rows();
      if (with_ssim) {
        schedule_tile_rows();
      } else {
        order_tile_rows();
      }
      ws_.reset_segments();
      record_stage(&StageTimes::project);
    });
    if (with_ssim) {
      try {
        train_with_ssim(training, thread);
      } catch (...) {
        schedule_.stop();
        throw;
      }
    } else {
      for_each_tile_row([&](int tile_row) { stages_.train_tile_row(ws_, training, tile_row, thread); });
    }
    pool_.barrier([&] {
      if (with_ssim) {
        stage_start_ms_ = now_ms();
      } else {
        record_stage(&StageTimes::render);
      }
    });
    stages_.update(ws_, update, thread);
    pool_.barrier([&] { record_stage(&StageTimes::update); });
  });

  if (ws_.stores_bounds) bounds_binding_id_ = state.binding_id;
  double total = with_ssim && view.weight_sum(masked) > 0.0 ? double(loss.ssim) : 0.0;
  if (loss.normalise_by_image) total *= view.mean_weight(masked);
  for (int t = 0; t < ws_.tiles_x * ws_.tiles_y; ++t) total += l1_sums_[size_t(t)];
  for (int k = 0; with_ssim && k <= ws_.tiles_y; ++k) total += ssim_sums_[size_t(k)];
  const double took_ms = now_ms() - started_ms;
  steps_ms_ += took_ms;
  if (masked) masked_steps_ms_ += took_ms;
  return total;
}

uint64_t Rasterizer::block_evaluations() const {
  uint64_t total = 0;
  for (const ThreadScratch& scratch : ws_.scratch) total += scratch.block_evaluations;
  return total;
}

uint32_t Rasterizer::visible_count() const {
  uint32_t total = 0;
  for (uint32_t s = 0; s < ws_.segments; ++s) total += ws_.segment_visible[s];
  return total;
}

void Rasterizer::copy_visible(uint32_t* ids) const {
  for (uint32_t s = 0; s < ws_.segments; ++s) {
    const VisibleSplat* visible = ws_.visible.data() + size_t(s) * kSegmentRows;
    for (uint32_t i = 0; i < ws_.segment_visible[s]; ++i) *ids++ = visible[i].id;
  }
}

}  // namespace gausslite
