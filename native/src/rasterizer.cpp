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

// Rows of the image that member `thread` works on.
struct Band {
  int begin, end;
  Band(int height, int thread, int threads) : begin(height * thread / threads), end(height * (thread + 1) / threads) {}
};

// The blocks of a tile that are inside the image, which goes on for so many pixels from the tile's corner.
uint16_t blocks_inside(int columns, int rows) {
  const int across = std::min((columns + kBlock - 1) / kBlock, kBlocksAcross);
  const int down = std::min((rows + kBlock - 1) / kBlock, kBlocksAcross);
  return uint16_t(((1u << across) - 1u) * 0x1111u & ((1u << kBlocksAcross * down) - 1u));
}

}  // namespace

Rasterizer::Rasterizer(const Stages& stages, int threads) : stages_(stages), team_(threads) {
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
  ws_.keeps_bounds = ws_.knows_bounds = false;
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  ws_.gradient_rows_used = 0;
  ws_.ticket = 0;
  ws_.hand_out_segments();
  for (ThreadScratch& scratch : ws_.scratch) {
    if (scratch.strips.size() <= size_t(ws_.tiles_y)) scratch.strips.resize(size_t(ws_.tiles_y) + 1);
    scratch.block_evaluations = 0;
  }
  ws_.wanted_blocks.reserve(tiles + 1);
  if (input.active_tiles != nullptr) ws_.active.look_at(input.active_tiles, ws_.tiles_x, ws_.tiles_y);
  times_ = {};
  last_mark_ms_ = now_ms();
}

// Of the active tiles, the blocks that the loss depends on; null: all inside the image.
void Rasterizer::want_blocks(const uint16_t* blocks) {
  for (int y = 0, t = 0; y < ws_.tiles_y; ++y) {
    for (int x = 0; x < ws_.tiles_x; ++x, ++t) {
      const bool active = ws_.active_tiles == nullptr || ws_.active_tiles[t];
      const uint16_t blocks_here =
          blocks != nullptr ? blocks[t] : blocks_inside(ws_.camera.width - x * kTile, ws_.camera.height - y * kTile);
      ws_.wanted_blocks[size_t(t)] = active ? blocks_here : uint16_t(0);
    }
  }
}

// Memory is zeroed when it grows, so 0 would read as written.
void Rasterizer::next_tag() {
  if (++ws_.tag == 0) ++ws_.tag;
}

// One more than there are: the update reads the row after a splat's only one before it knows that there is none.
void Rasterizer::prepare_gradient_rows() {
  ws_.gradient_rows.reserve((size_t(ws_.gradient_rows_used.load()) + 1) * kRowWidth);
}

void Rasterizer::mark(double StageTimes::*stage) {
  const double now = now_ms();
  times_.*stage = now - std::exchange(last_mark_ms_, now);
}

// The bounds of rows that are lent are kept from the first step that looks at all of them.
void Rasterizer::use_bounds(uint64_t loan) {
  ws_.knows_bounds = loan != 0 && loan == bounds_loan_;
  ws_.keeps_bounds = loan != 0 && (ws_.knows_bounds || ws_.ids == nullptr);
  if (ws_.keeps_bounds) ws_.bounds.reserve(size_t(row_count_) / 16 + 1);
  bounds_loan_ = 0;  // until the step is done
}

// The heaviest tile rows come first: then the threads have little to wait for at the end.
void Rasterizer::order_strips() {
  strip_order_.clear();
  for (int y = 0; y < ws_.tiles_y; ++y) strip_order_.emplace_back(keys_of_strip(y), y);
  std::sort(strip_order_.begin(), strip_order_.end(), std::greater<>());
}

uint32_t Rasterizer::keys_of_strip(int y) const {
  uint32_t keys = 0;
  for (const ThreadScratch& scratch : ws_.scratch) keys += scratch.strips[size_t(y)].count;
  return keys;
}

// With SSIM strips are begun side by side instead.
void Rasterizer::schedule_strips() {
  strip_weights_.clear();
  for (int y = 0; y < ws_.tiles_y; ++y) strip_weights_.push_back(keys_of_strip(y));
  schedule_.start(strip_weights_, team_.size(), StripSchedule::tape_places(team_.size()));
}

template <class F>
void Rasterizer::for_each_strip(F f) {
  for (int i; (i = ws_.ticket.fetch_add(1, std::memory_order_relaxed)) < ws_.tiles_y;) {
    f(strip_order_[size_t(i)].second);
  }
}

void Rasterizer::forward(const FrameInput& input, const ImageOutput& output) {
  begin_frame(input);
  want_blocks(nullptr);
  const size_t tiles = size_t(ws_.tiles_x) * size_t(ws_.tiles_y);
  if (ws_.tiles.size() < tiles) ws_.tiles.resize(tiles);
  ws_.image.reserve(5 * size_t(ws_.plane));
  ws_.image_gradient.reserve(5 * size_t(ws_.plane));
  team_.run([&](int thread) {
    stages_.project(ws_, thread);
    team_.barrier([&] {
      order_strips();
      mark(&StageTimes::project);
    });
    for_each_strip([&](int strip) { stages_.draw_strip(ws_, strip, thread); });
    team_.barrier([&] { mark(&StageTimes::raster); });
    const Band band(ws_.camera.height, thread, team_.size());
    export_image(ws_, output, band.begin, band.end);
  });
}

void Rasterizer::backward(const ImageGradients& input, float* d_rows, double* d_twist, float* mean_2d_norm) {
  last_mark_ms_ = now_ms();
  ws_.ticket = 0;
  ws_.hand_out_segments();
  next_tag();  // a second backward of the same forward must not add to the first one's rows
  prepare_gradient_rows();
  twist_sums_.reserve(6 * size_t(ws_.segments) + 6);
  std::fill_n(twist_sums_.data(), 6 * size_t(ws_.segments), 0.0);
  norms_by_slot_.reserve(size_t(ws_.count) + 1);
  const GradientOutput output{d_rows, norms_by_slot_.data(), twist_sums_.data()};
  team_.run([&](int thread) {
    const Band band(ws_.tiles_y * kTile, thread, team_.size());
    import_gradients(ws_, input, band.begin, band.end);
    team_.barrier();
    for_each_strip([&](int strip) { stages_.backward_strip(ws_, strip, thread); });
    team_.barrier([&] { mark(&StageTimes::backward); });
    stages_.gradients(ws_, output, thread);
    team_.barrier([&] { mark(&StageTimes::update); });
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
    want_blocks(training.targets.weighted_blocks);
  } else {
    want_blocks(training.targets.reached_blocks);
    const int tapes = StripSchedule::tape_places(team_.size());
    const size_t rows = size_t(StripSchedule::square_places(tapes));
    if (ws_.tapes.size() < size_t(tapes)) ws_.tapes.resize(size_t(tapes));
    if (ws_.ssim_squares.size() < rows) ws_.ssim_squares.resize(rows);
    for (Buffer<float>& squares : ws_.ssim_squares) squares.reserve(ssim_square(ws_.tiles_x, 0, 0));
  }
  return training;
}

void Rasterizer::train_with_ssim(const Training& training, int thread) {
  StageTimes spent;
  double started_ms = now_ms();
  for (StripTask task; (task = schedule_.next(thread)).kind != StripTask::kNone;) {
    const auto tape = [&](int i) { return task.tapes[i] >= 0 ? &ws_.tapes[size_t(task.tapes[i])] : nullptr; };
    const auto squares = [&](int i) { return ws_.ssim_squares[size_t(task.squares[i])].data(); };
    double StageTimes::*stage = &StageTimes::raster;
    if (task.kind == StripTask::kDraw) {
      stages_.draw_on_tape(ws_, training, *tape(0), task.index, thread);
    } else if (task.kind == StripTask::kDerive) {
      stages_.derive_ssim(ws_, training, {task.index, tape(0), tape(1), squares(0)}, thread);
      stage = &StageTimes::loss;
    } else {
      stages_.walk_back_on_tape(ws_, training, {task.index, *tape(0), squares(0), squares(1)});
      stage = &StageTimes::backward;
    }
    schedule_.finish(task);
    const double now = now_ms();
    spent.*stage += now - std::exchange(started_ms, now);
  }
  spent.backward += now_ms() - started_ms;  // the wait for the last strips, which others walk back
  if (thread == 0) {
    times_.raster = spent.raster;
    times_.loss = spent.loss;
    times_.backward = spent.backward;
  }
}

double Rasterizer::step(const FrameInput& input, const OptimizerState& state, const TrainingView& view, bool masked,
                        const LossWeights& loss, const AdamOptions& adam) {
  const double started_ms = now_ms();
  begin_frame(input);
  use_bounds(state.loan);
  const Training training = begin_training(view, masked, loss);
  const bool with_ssim = loss.ssim != 0.0f;
  Update update{state.rows, state.first_moment, state.second_moment, state.trainable, state.trained, state.counted, {}};
  std::copy_n(adam.rates, 16, update.adam.rates);
  update.adam.beta1 = float(adam.beta1);
  update.adam.beta2 = float(adam.beta2);
  update.adam.epsilon = float(adam.epsilon);
  update.adam.corrections = corrections_.table(adam.beta1, adam.beta2, adam.decay_after_updates);
  update.adam.correction_count = AdamCorrections::kCount;

  team_.run([&](int thread) {
    stages_.project(ws_, thread);
    team_.barrier([&] {
      prepare_gradient_rows();
      if (with_ssim) {
        schedule_strips();
      } else {
        order_strips();
      }
      ws_.hand_out_segments();
      mark(&StageTimes::project);
    });
    if (with_ssim) {
      try {
        train_with_ssim(training, thread);
      } catch (...) {
        schedule_.stop();
        throw;
      }
    } else {
      for_each_strip([&](int strip) { stages_.train_strip(ws_, training, strip, thread); });
    }
    team_.barrier([&] {
      if (with_ssim) {
        last_mark_ms_ = now_ms();
      } else {
        mark(&StageTimes::raster);
      }
    });
    stages_.update(ws_, update, thread);
    team_.barrier([&] { mark(&StageTimes::update); });
  });

  if (ws_.keeps_bounds) bounds_loan_ = state.loan;
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
