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

// Image rows of one thread.
struct Band {
  int begin, end;
  Band(int height, int thread, int threads) : begin(height * thread / threads), end(height * (thread + 1) / threads) {}
};

// The blocks of a tile inside an image that extends `columns` and `rows` pixels from the corner of the tile.
uint16_t blocks_inside(int columns, int rows) {
  const int across = std::min((columns + kBlock - 1) / kBlock, kBlocksAcross);
  const int down = std::min((rows + kBlock - 1) / kBlock, kBlocksAcross);
  return uint16_t(((1u << across) - 1u) * 0x1111u & ((1u << kBlocksAcross * down) - 1u));
}

}  // namespace

Rasterizer::Rasterizer(const Stages& stages, int threads) : stages_(stages), pool_(threads) {
  ws_.threads = threads;
  ws_.scratch = std::vector<ThreadScratch>(size_t(threads));
}

void Rasterizer::begin_frame(const FrameInput& input) {
  ws_.camera = input.camera;
  ws_.tiles_x = (input.camera.width + kTile - 1) / kTile;
  ws_.tiles_y = (input.camera.height + kTile - 1) / kTile;
  ws_.padded_width = ws_.tiles_x * kTile;
  ws_.plane = int64_t(ws_.padded_width) * ws_.tiles_y * kTile;
  row_count_ = input.row_count;
  ws_.rows = input.rows;
  ws_.ids = input.ids;
  ws_.count = input.ids != nullptr ? input.id_count : input.row_count;
  ws_.active_tiles = input.active_tiles;
  ++frame_;
  next_tag();
  ws_.segments = (ws_.count + kSegment - 1) / kSegment;
  ws_.splats.reserve(size_t(ws_.count) + 1);
  ws_.visible.reserve(size_t(ws_.count) + 1);
  ws_.segment_visible.reserve(ws_.segments + 1);
  ws_.segment_thread.reserve(ws_.segments + 1);
  ws_.segment_keys.reserve(size_t(ws_.segments + 1) * size_t(ws_.tiles_y));
  ws_.stores_bounds = ws_.has_bounds = false;
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  ws_.gradient_rows_used = 0;
  ws_.ticket = 0;
  ws_.reset_segments();
  for (ThreadScratch& scratch : ws_.scratch) {
    if (scratch.tile_rows.size() <= size_t(ws_.tiles_y)) scratch.tile_rows.resize(size_t(ws_.tiles_y) + 1);
    scratch.block_evaluations = 0;
  }
  ws_.needed_blocks.reserve(tiles + 1);
  if (input.active_tiles != nullptr) ws_.active.assign(input.active_tiles, ws_.tiles_x, ws_.tiles_y);
  times_ = {};
  stage_start_ms_ = now_ms();
}

// Selects, in the active tiles, the blocks that the loss depends on; null: all blocks inside the image.
void Rasterizer::select_blocks(const uint16_t* blocks) {
  for (int y = 0, t = 0; y < ws_.tiles_y; ++y) {
    for (int x = 0; x < ws_.tiles_x; ++x, ++t) {
      const bool active = ws_.active_tiles == nullptr || ws_.active_tiles[t];
      const uint16_t blocks_here =
          blocks != nullptr ? blocks[t] : blocks_inside(ws_.camera.width - x * kTile, ws_.camera.height - y * kTile);
      ws_.needed_blocks[size_t(t)] = active ? blocks_here : uint16_t(0);
    }
  }
}

// 0 is no tag: new memory is zero and would count as written in this pass.
void Rasterizer::next_tag() {
  if (++ws_.tag == 0) ++ws_.tag;
}

// One additional row: the update loads a second row for each splat before it checks the number of rows.
void Rasterizer::prepare_gradient_rows() {
  ws_.gradient_rows.reserve((size_t(ws_.gradient_rows_used.load()) + 1) * kRowWidth);
}

void Rasterizer::record_stage(double StageTimes::* stage) {
  const double now = now_ms();
  times_.*stage = now - std::exchange(stage_start_ms_, now);
}

// Bounds of bound rows are stored from the first step that projects all rows.
void Rasterizer::select_bounds(uint64_t binding_id) {
  ws_.has_bounds = binding_id != 0 && binding_id == bounds_binding_id_;
  ws_.stores_bounds = binding_id != 0 && (ws_.has_bounds || ws_.ids == nullptr);
  if (ws_.stores_bounds) ws_.bounds.reserve(size_t(row_count_) / 16 + 1);
  bounds_binding_id_ = 0;  // invalid until the step ends
}

// Tile rows with most keys first, so that the threads end at nearly the same time.
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

// With SSIM each thread starts at adjacent tile rows instead.
void Rasterizer::schedule_tile_rows() {
  tile_row_weights_.clear();
  for (int y = 0; y < ws_.tiles_y; ++y) tile_row_weights_.push_back(tile_row_keys(y));
  schedule_.start(tile_row_weights_, pool_.size(), TileRowSchedule::replay_slots(pool_.size()));
}

template <class F>
void Rasterizer::for_each_tile_row(F f) {
  for (int i; (i = ws_.ticket.fetch_add(1, std::memory_order_relaxed)) < ws_.tiles_y;) {
    f(tile_row_order_[size_t(i)].second);
  }
}

void Rasterizer::forward(const FrameInput& input, const ImageOutput& output) {
  begin_frame(input);
  select_blocks(nullptr);
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  if (ws_.tiles.size() < tiles) ws_.tiles.resize(tiles);
  ws_.image.reserve(5 * size_t(ws_.plane));
  ws_.image_gradient.reserve(5 * size_t(ws_.plane));
  pool_.run([&](int thread) {
    stages_.project(ws_, thread);
    pool_.barrier([&] {
      order_tile_rows();
      record_stage(&StageTimes::project);
    });
    for_each_tile_row([&](int tile_row) { stages_.render_tile_row(ws_, tile_row, thread); });
    pool_.barrier([&] { record_stage(&StageTimes::raster); });
    const Band band(ws_.camera.height, thread, pool_.size());
    export_image(ws_, output, band.begin, band.end);
  });
}

void Rasterizer::backward(const ImageGradients& input, float* d_rows, double* d_twist, float* mean_2d_norm) {
  stage_start_ms_ = now_ms();
  ws_.ticket = 0;
  ws_.reset_segments();
  next_tag();  // a second backward of the same forward must not add to the first one's rows
  prepare_gradient_rows();
  twist_sums_.reserve(6 * size_t(ws_.segments) + 6);
  std::fill_n(twist_sums_.data(), 6 * size_t(ws_.segments), 0.0);
  norms_by_slot_.reserve(size_t(ws_.count) + 1);
  const GradientOutput output{d_rows, norms_by_slot_.data(), twist_sums_.data()};
  pool_.run([&](int thread) {
    const Band band(ws_.tiles_y * kTile, thread, pool_.size());
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
    const float* norms = norms_by_slot_.data() + size_t(s) * kSegment;
    mean_2d_norm = std::copy_n(norms, ws_.segment_visible[s], mean_2d_norm);
  }
}

Training Rasterizer::begin_training(const TrainingView& view, bool masked, const LossWeights& loss) {
  const double weight_sum = view.weight_sum(masked), share = loss.normalise_by_image ? view.share(masked) : 1.0;
  const double per_pixel = weight_sum > 0.0 ? share / weight_sum : 0.0;
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  for (ThreadScratch& scratch : ws_.scratch) {
    if (scratch.tiles.size() < size_t(ws_.tiles_x)) scratch.tiles.resize(size_t(ws_.tiles_x));
  }
  l1_sums_.reserve(tiles);
  ssim_sums_.reserve(size_t(ws_.tiles_y) + 1);
  const Training training{
      view.targets(masked),
      {float(loss.colour * per_pixel / 3.0), float(loss.depth * per_pixel), float(loss.ssim * per_pixel / 3.0)},
      l1_sums_.data(),
      ssim_sums_.data()};
  if (loss.ssim == 0.0f) {
    select_blocks(training.targets.weighted_blocks);
  } else {
    select_blocks(training.targets.reached_blocks);
    const int replays = TileRowSchedule::replay_slots(pool_.size());
    const size_t rows = size_t(TileRowSchedule::square_slots(replays));
    if (ws_.replays.size() < size_t(replays)) ws_.replays.resize(size_t(replays));
    if (ws_.ssim_squares.size() < rows) ws_.ssim_squares.resize(rows);
    for (Buffer<float>& squares : ws_.ssim_squares) squares.reserve(ssim_square(ws_.tiles_x, 0, 0));
  }
  return training;
}

void Rasterizer::train_with_ssim(const Training& training, int thread) {
  StageTimes stage_ms;
  double started_ms = now_ms();
  for (TileRowTask task; (task = schedule_.next(thread)).kind != TileRowTask::kNone;) {
    const auto replay = [&](int i) { return task.replays[i] >= 0 ? &ws_.replays[size_t(task.replays[i])] : nullptr; };
    const auto squares = [&](int i) { return ws_.ssim_squares[size_t(task.squares[i])].data(); };
    double StageTimes::* stage = &StageTimes::raster;
    if (task.kind == TileRowTask::kRender) {
      stages_.render_to_replay(ws_, training, *replay(0), task.index, thread);
    } else if (task.kind == TileRowTask::kSsim) {
      stages_.derive_ssim(ws_, training, {task.index, replay(0), replay(1), squares(0)}, thread);
      stage = &StageTimes::loss;
    } else {
      stages_.backward_from_replay(ws_, training, {task.index, *replay(0), squares(0), squares(1)});
      stage = &StageTimes::backward;
    }
    schedule_.finish(task);
    const double now = now_ms();
    stage_ms.*stage += now - std::exchange(started_ms, now);
  }
  stage_ms.backward += now_ms() - started_ms;  // includes the wait for the last tile rows, which other threads process
  if (thread == 0) {
    times_.raster = stage_ms.raster;
    times_.loss = stage_ms.loss;
    times_.backward = stage_ms.backward;
  }
}

double Rasterizer::step(const FrameInput& input, const OptimizerState& state, const TrainingView& view, bool masked,
                        const LossWeights& loss, const AdamOptions& adam) {
  const double started_ms = now_ms();
  begin_frame(input);
  select_bounds(state.binding_id);
  const Training training = begin_training(view, masked, loss);
  const bool with_ssim = loss.ssim != 0.0f;
  Update update{
      state.rows, state.first_moment, state.second_moment, state.trainable, state.update_counts, state.count_mask, {}};
  std::copy_n(adam.rates, 16, update.adam.rates);
  update.adam.beta1 = float(adam.beta1);
  update.adam.beta2 = float(adam.beta2);
  update.adam.epsilon = float(adam.epsilon);
  update.adam.corrections = corrections_.table(adam.beta1, adam.beta2, adam.decay_after_updates);
  update.adam.correction_count = AdamCorrections::kCount;

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
        record_stage(&StageTimes::raster);
      }
    });
    stages_.update(ws_, update, thread);
    pool_.barrier([&] { record_stage(&StageTimes::update); });
  });

  if (ws_.stores_bounds) bounds_binding_id_ = state.binding_id;
  double total = with_ssim && view.weight_sum(masked) > 0.0 ? double(loss.ssim) : 0.0;
  if (loss.normalise_by_image) total *= view.share(masked);
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
    const Visible* visible = ws_.visible.data() + size_t(s) * kSegment;
    for (uint32_t i = 0; i < ws_.segment_visible[s]; ++i) *ids++ = visible[i].id;
  }
}

}  // namespace gausslite
