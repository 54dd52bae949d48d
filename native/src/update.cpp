// SPDX-License-Identifier: Apache-2.0
// From image gradients (row_layout.h) to parameters, for the visible splats of a segment: Stages::update and
// Stages::gradients. Gradients are either written out or applied by Adam at once, while the three rows of a splat
// (parameters and two moments) are in cache.
#include <algorithm>
#include <cstring>
#include <limits>

#include "candidates.h"
#include "projection_backward.h"
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// Sixteen visible splats: their rows and the sums of their gradient rows, transposed.
struct Group {
  Pack16 row[16], image_gradient[16];
  uint32_t id[16];
  int lanes;

  GAUSSLITE_INLINE Group(const Workspace& ws, uint32_t slot, int n) : lanes(n) {
    for (int j = 0; j < 16; ++j) {
      const VisibleSplat& splat = ws.visible[slot + uint32_t(std::min(j, n - 1))];
      id[j] = splat.id;
      row[j] = load(ws.rows + size_t(kRowWidth) * splat.id);
      // Most splats have one or two gradient rows. Both are always read, and masked: no branch to mispredict.
      const uint32_t rows = j < n ? splat.gradient_rows : 0;
      image_gradient[j] = gradient(ws, splat.gradient_row, rows > 0) + gradient(ws, splat.gradient_row + 1, rows > 1);
      for (uint32_t r = 2; r < rows; ++r)
        image_gradient[j] = image_gradient[j] + gradient(ws, splat.gradient_row + r, true);
    }
    transpose(row);
    transpose(image_gradient);
  }

 private:
  // Returns a gradient row; zeros if it is not used or this pass did not write it.
  GAUSSLITE_INLINE static Pack16 gradient(const Workspace& ws, uint32_t index, bool is_used) {
    const float* row = ws.gradient_rows.data() + size_t(kRowWidth) * index;
    uint32_t row_pass;
    std::memcpy(&row_pass, row + kPassNumber, sizeof row_pass);
    return zero_unless(is_used & (row_pass == ws.gradient_pass), load(row));
  }
};

// First slot of a group, and end of its segment.
struct Slots {
  uint32_t first, end;

  // Slot of lane j in the next group; the last slot if there is none.
  GAUSSLITE_INLINE uint32_t next(int j) const { return std::min(first + 16 + uint32_t(j), end - 1); }
};

// Calls f(segment, group, slots) for the visible splats of this thread's segments, sixteen at a time. Calls
// prefetch_splat(splat) for the first sixteen splats of a segment; f must call it for the others.
template <class Prefetch, class F>
GAUSSLITE_INLINE void for_each_group(Workspace& ws, int thread, Prefetch prefetch_splat, F f) {
  for (uint32_t s; (s = ws.take_segment(thread)) < ws.segments;) {
    const uint32_t begin = s * kSegmentRows, end = begin + ws.segment_visible[s];
    for (uint32_t slot = begin; slot < std::min(begin + 16, end); ++slot) prefetch_splat(ws.visible[slot]);
    for (uint32_t slot = begin; slot < end; slot += 16) {
      const Group group(ws, slot, int(std::min(16u, end - slot)));
      f(s, group, Slots{slot, end});
    }
  }
}

// Adam on whole rows. Columns kGradSum and kGradCount of the first moment are sums over the steps, not averages: in
// these two lanes, the decay and the gain of the first moment are 1. Column kUpdates of the row increases by one.
class Adam {
 public:
  GAUSSLITE_INLINE explicit Adam(const UpdateArguments& args)
      : args_(args), rate_(load(args.adam.rates)), epsilon_(args.adam.epsilon) {
    const AdamSettings& adam = args.adam;
    alignas(64) float lanes[5][16];
    for (int k = 0; k < 16; ++k) {
      const bool trained = k < kTrainedColumns;
      lanes[0][k] = trained ? adam.beta1 : 1.0f;
      lanes[1][k] = trained ? 1.0f - adam.beta1 : 1.0f;
      lanes[2][k] = trained ? adam.beta2 : 1.0f;
      lanes[3][k] = trained ? 1.0f - adam.beta2 : 0.0f;
      lanes[4][k] = k == kUpdates ? 1.0f : 0.0f;
    }
    first_decay_ = load(lanes[0]);
    first_gain_ = load(lanes[1]);
    second_decay_ = load(lanes[2]);
    second_gain_ = load(lanes[3]);
    update_increment_ = load(lanes[4]);
  }

  GAUSSLITE_INLINE void step(uint32_t id, Pack16 gradient) const {
    const size_t at = size_t(kRowWidth) * id;
    float *row = args_.rows + at, *m = args_.first_moment + at, *v = args_.second_moment + at;
    // Two values per number of updates (AdamCorrections::table): the learning-rate decay with the bias correction of
    // the first moment, and the bias correction of the second.
    const float* factors = args_.adam.step_factors + 2 * step_factor_index(row[kUpdates]);
    const float rate_factor = factors[0], second_correction = factors[1];
    const Pack16 m_new = fma(load(m), first_decay_, gradient * first_gain_);
    const Pack16 v_new = fma(load(v), second_decay_, gradient * gradient * second_gain_);
    store(m, m_new);
    store(v, v_new);
    // 14 bits suffice for the size of a step. The smallest float avoids 0 / 0 in unused columns.
    const Pack16 square = max(v_new * second_correction, Pack16(std::numeric_limits<float>::min()));
    const Pack16 denominator = fma(square, rough_inverse_sqrt(square), epsilon_);
    store(row, fnma(rate_ * rate_factor, m_new * rough_reciprocal(denominator), load(row)) + update_increment_);
  }

 private:
  // Limits the index to the table: the number of updates of an uninitialised row may be any value.
  GAUSSLITE_INLINE size_t step_factor_index(float updates) const {
    const float last = float(args_.adam.step_factor_count - 1);
    return updates > 0.0f ? size_t(std::min(updates, last)) : 0;
  }

  const UpdateArguments& args_;
  Pack16 rate_, epsilon_, first_decay_, first_gain_, second_decay_, second_gain_, update_increment_;
};

template <bool kMotion>
void update_splats(Workspace& ws, const UpdateArguments& args, int thread) {
  const Adam adam(args);
  const auto prefetch_splat = [&](const VisibleSplat& splat) {
    const size_t at = size_t(kRowWidth) * splat.id;
    prefetch_to_write(args.rows + at);
    prefetch_to_write(args.first_moment + at);
    prefetch_to_write(args.second_moment + at);
  };
  for_each_group(ws, thread, prefetch_splat, [&](uint32_t, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<false, kMotion>(group.row, group.image_gradient, ws.camera, g);
    zero_invalid(g);
    g.column[kGradSum] = g.mean_2d_grad_norm;
    g.column[kGradCount] = Pack16(1.0f);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      const uint32_t id = group.id[j];
      // Spread the prefetches over the updates: a core has about two dozen outstanding cache lines.
      prefetch_splat(ws.visible[slots.next(j)]);
      adam.step(id, g.column[j]);
      if (ws.stores_bounds) store_row_bounds(ws, id, args.rows + size_t(kRowWidth) * id);
      if (args.update_counts != nullptr && (args.count_mask == nullptr || args.count_mask[id]))
        ++args.update_counts[id];
    }
  });
}

template <bool kMotion>
void write_gradients(Workspace& ws, const GradientOutput& args, int thread) {
  const auto prefetch_splat = [&](const VisibleSplat& splat) { prefetch(ws.rows + size_t(kRowWidth) * splat.id); };
  for_each_group(ws, thread, prefetch_splat, [&](uint32_t segment, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<true, kMotion>(group.row, group.image_gradient, ws.camera, g);
    zero_invalid(g);
    for (int k = 0; k < 6; ++k) {
      args.d_twist[6 * size_t(segment) + size_t(k)] += double(sum(zero_unless(is_finite(g.twist[k]), g.twist[k])));
    }
    alignas(64) float norms[16];
    store(norms, g.mean_2d_grad_norm);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      prefetch_splat(ws.visible[slots.next(j)]);
      store(args.d_rows + size_t(kRowWidth) * group.id[j], g.column[j]);
      args.mean_2d_grad_norm[slots.first + uint32_t(j)] = norms[j];
    }
  });
}

}  // namespace

void update(Workspace& ws, const UpdateArguments& args, int thread) {
  ws.camera.moves ? update_splats<true>(ws, args, thread) : update_splats<false>(ws, args, thread);
}

void gradients(Workspace& ws, const GradientOutput& args, int thread) {
  ws.camera.moves ? write_gradients<true>(ws, args, thread) : write_gradients<false>(ws, args, thread);
}

}  // namespace gausslite::GAUSSLITE_ISA
