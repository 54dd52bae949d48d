// SPDX-License-Identifier: Apache-2.0
// Stage 7: from image gradients to parameters, for the visible splats of a segment. Gradients are either written out or
// applied by Adam at once, while the three rows of a splat (parameters and two moments) are in cache.
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
  Pack16 row[16], image[16];
  uint32_t id[16];
  int lanes;

  GAUSSLITE_INLINE Group(const Workspace& ws, uint32_t slot, int n) : lanes(n) {
    for (int j = 0; j < 16; ++j) {
      const Visible& splat = ws.visible[slot + uint32_t(std::min(j, n - 1))];
      id[j] = splat.id;
      row[j] = load(ws.rows + size_t(kRowWidth) * splat.id);
      // Most splats have one or two gradient rows. Both are always read, and masked: no branch to mispredict.
      const uint32_t rows = j < n ? splat.gradient_rows : 0;
      image[j] = gradient(ws, splat.gradient_row, rows > 0) + gradient(ws, splat.gradient_row + 1, rows > 1);
      for (uint32_t r = 2; r < rows; ++r) image[j] = image[j] + gradient(ws, splat.gradient_row + r, true);
    }
    transpose(row);
    transpose(image);
  }

 private:
  // A gradient row, or zeros if this pass did not write it.
  GAUSSLITE_INLINE static Pack16 gradient(const Workspace& ws, uint32_t index, bool counts) {
    const float* row = ws.gradient_rows.data() + size_t(kRowWidth) * index;
    uint32_t tag;
    std::memcpy(&tag, row + kRowTag, sizeof tag);
    return keep_if(counts & (tag == ws.tag), load(row));
  }
};

// First slot of a group, and end of its segment.
struct Slots {
  uint32_t first, end;

  // Slot of lane j in the next group; the last slot if there is none.
  GAUSSLITE_INLINE uint32_t next(int j) const { return std::min(first + 16 + uint32_t(j), end - 1); }
};

// Calls f(segment, group, slots) for the visible splats of the segments, sixteen at a time. Calls prefetch_splat(splat)
// for the first sixteen of a segment; f does that for the following ones.
template <class Prefetch, class F>
GAUSSLITE_INLINE void for_each_group(Workspace& ws, int thread, Prefetch prefetch_splat, F f) {
  for (uint32_t s; (s = ws.take_segment(thread)) < ws.segments;) {
    const uint32_t begin = s * kSegment, end = begin + ws.segment_visible[s];
    for (uint32_t slot = begin; slot < std::min(begin + 16, end); ++slot) prefetch_splat(ws.visible[slot]);
    for (uint32_t slot = begin; slot < end; slot += 16) {
      const Group group(ws, slot, int(std::min(16u, end - slot)));
      f(s, group, Slots{slot, end});
    }
  }
}

// Adam on whole rows. The statistics in columns 14 and 15 of the first moment are sums: the recurrence of Adam with
// other factors in those lanes. Column 14 of the row, the update count, increases by one.
class Adam {
 public:
  GAUSSLITE_INLINE explicit Adam(const Update& job)
      : job_(job), rate_(load(job.adam.rates)), epsilon_(job.adam.epsilon) {
    const AdamSettings& adam = job.adam;
    alignas(64) float factors[5][16];
    for (int k = 0; k < 16; ++k) {
      const bool update_counts = k < kTrainedColumns;
      factors[0][k] = update_counts ? adam.beta1 : 1.0f;
      factors[1][k] = update_counts ? 1.0f - adam.beta1 : 1.0f;
      factors[2][k] = update_counts ? adam.beta2 : 1.0f;
      factors[3][k] = update_counts ? 1.0f - adam.beta2 : 0.0f;
      factors[4][k] = k == kUpdates ? 1.0f : 0.0f;
    }
    keep1_ = load(factors[0]);
    add1_ = load(factors[1]);
    keep2_ = load(factors[2]);
    add2_ = load(factors[3]);
    count_ = load(factors[4]);
  }

  GAUSSLITE_INLINE void step(uint32_t id, Pack16 gradient) const {
    const size_t at = size_t(kRowWidth) * id;
    float *row = job_.rows + at, *m = job_.first_moment + at, *v = job_.second_moment + at;
    const float* correction = job_.adam.corrections + 2 * correction_index(row[kUpdates]);
    const Pack16 m_new = fma(load(m), keep1_, gradient * add1_);
    const Pack16 v_new = fma(load(v), keep2_, gradient * gradient * add2_);
    store(m, m_new);
    store(v, v_new);
    // 14 bits suffice for the size of a step. The smallest float avoids 0 / 0 in unused columns.
    const Pack16 square = max(v_new * correction[1], Pack16(std::numeric_limits<float>::min()));
    const Pack16 size = fma(square, rough_inverse_sqrt(square), epsilon_);
    store(row, fnma(rate_ * correction[0], m_new * rough_reciprocal(size), load(row)) + count_);
  }

 private:
  // The count of an uninitialised row may be any value.
  GAUSSLITE_INLINE size_t correction_index(float updates) const {
    const float last = float(job_.adam.correction_count - 1);
    return updates > 0.0f ? size_t(std::min(updates, last)) : 0;
  }

  const Update& job_;
  Pack16 rate_, epsilon_, keep1_, add1_, keep2_, add2_, count_;
};

}  // namespace

void update(Workspace& ws, const Update& job, int thread) {
  const Adam adam(job);
  const auto prefetch_splat = [&](const Visible& splat) {
    const size_t at = size_t(kRowWidth) * splat.id;
    prefetch_to_write(job.rows + at);
    prefetch_to_write(job.first_moment + at);
    prefetch_to_write(job.second_moment + at);
  };
  for_each_group(ws, thread, prefetch_splat, [&](uint32_t, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<false>(group.row, group.image, ws.camera, g);
    zero_invalid(g);
    g.column[kGradSum] = g.mean_2d_norm;
    g.column[kGradCount] = Pack16(1.0f);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      const uint32_t id = group.id[j];
      // Spread the prefetches over the updates: a core has about two dozen outstanding cache lines.
      prefetch_splat(ws.visible[slots.next(j)]);
      if (job.trainable != nullptr && !job.trainable[id]) continue;
      adam.step(id, g.column[j]);
      if (ws.stores_bounds) store_row_bounds(ws, id, job.rows + size_t(kRowWidth) * id);
      if (job.update_counts != nullptr && (job.count_mask == nullptr || job.count_mask[id])) ++job.update_counts[id];
    }
  });
}

void gradients(Workspace& ws, const GradientOutput& job, int thread) {
  const auto prefetch_splat = [&](const Visible& splat) { prefetch(ws.rows + size_t(kRowWidth) * splat.id); };
  for_each_group(ws, thread, prefetch_splat, [&](uint32_t segment, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<true>(group.row, group.image, ws.camera, g);
    zero_invalid(g);
    for (int k = 0; k < 6; ++k) {
      job.d_twist[6 * size_t(segment) + size_t(k)] += double(sum(keep(is_finite(g.twist[k]), g.twist[k])));
    }
    alignas(64) float norms[16];
    store(norms, g.mean_2d_norm);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      prefetch_splat(ws.visible[slots.next(j)]);
      store(job.d_rows + size_t(kRowWidth) * group.id[j], g.column[j]);
      job.mean_2d_norm[slots.first + uint32_t(j)] = norms[j];
    }
  });
}

}  // namespace gausslite::GAUSSLITE_ISA
