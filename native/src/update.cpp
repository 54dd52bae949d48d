// SPDX-License-Identifier: Apache-2.0
// Stage 7: image gradients to parameters, for the visible splats, a segment at a time: either written out as
// gradients, or fed to Adam on the spot, while the three rows of a splat (parameters and two moments) are in cache.
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
      // One or two are the rule. Both are read always, and only then counted or not: no branch to mispredict.
      const uint32_t rows = j < n ? splat.gradient_rows : 0;
      image[j] = gradient(ws, splat.gradient_row, rows > 0) + gradient(ws, splat.gradient_row + 1, rows > 1);
      for (uint32_t r = 2; r < rows; ++r) image[j] = image[j] + gradient(ws, splat.gradient_row + r, true);
    }
    transpose(row);
    transpose(image);
  }

 private:
  // A gradient row, or zeros if this pass has not written it.
  GAUSSLITE_INLINE static Pack16 gradient(const Workspace& ws, uint32_t index, bool counts) {
    const float* row = ws.gradient_rows.data() + size_t(kRowWidth) * index;
    uint32_t tag;
    std::memcpy(&tag, row + kRowTag, sizeof tag);
    return keep_if(counts & (tag == ws.tag), load(row));
  }
};

// Where a group begins, and where its segment ends.
struct Slots {
  uint32_t first, end;

  // The one that lane j's follower is in; the last one again where there is none.
  GAUSSLITE_INLINE uint32_t next(int j) const { return std::min(first + 16 + uint32_t(j), end - 1); }
};

// Calls f(segment, group, slots) for the visible splats of the segments that are left to do, sixteen at a time, after
// ask_for(splat) for each of the first sixteen of a segment; f does that for those that follow it.
template <class Ask, class F>
GAUSSLITE_INLINE void for_each_group(Workspace& ws, int thread, Ask ask_for, F f) {
  for (uint32_t s; (s = ws.take_segment(thread)) < ws.segments;) {
    const uint32_t begin = s * kSegment, end = begin + ws.segment_visible[s];
    for (uint32_t slot = begin; slot < std::min(begin + 16, end); ++slot) ask_for(ws.visible[slot]);
    for (uint32_t slot = begin; slot < end; slot += 16) {
      const Group group(ws, slot, int(std::min(16u, end - slot)));
      f(s, group, Slots{slot, end});
    }
  }
}

// Adam on whole rows. The statistics in columns 14 and 15 of the first moment are plain sums, which is Adam's
// recurrence with other factors in those lanes; the update count in column 14 of the row moves by one.
class Adam {
 public:
  GAUSSLITE_INLINE explicit Adam(const Update& job)
      : job_(job), rate_(load(job.adam.rates)), epsilon_(job.adam.epsilon) {
    const AdamSettings& adam = job.adam;
    alignas(64) float factors[5][16];
    for (int k = 0; k < 16; ++k) {
      const bool trained = k < kTrained;
      factors[0][k] = trained ? adam.beta1 : 1.0f;
      factors[1][k] = trained ? 1.0f - adam.beta1 : 1.0f;
      factors[2][k] = trained ? adam.beta2 : 1.0f;
      factors[3][k] = trained ? 1.0f - adam.beta2 : 0.0f;
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
    // Fourteen bits are ample for the size of a step. The smallest float keeps 0 / 0 out of untouched columns.
    const Pack16 square = max(v_new * correction[1], Pack16(std::numeric_limits<float>::min()));
    const Pack16 size = fma(square, rough_inverse_sqrt(square), epsilon_);
    store(row, fnma(rate_ * correction[0], m_new * rough_reciprocal(size), load(row)) + count_);
  }

 private:
  // The count of a row that nobody has set may hold anything.
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
  const auto ask_for = [&](const Visible& splat) {
    const size_t at = size_t(kRowWidth) * splat.id;
    prefetch_to_write(job.rows + at);
    prefetch_to_write(job.first_moment + at);
    prefetch_to_write(job.second_moment + at);
  };
  for_each_group(ws, thread, ask_for, [&](uint32_t, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<false>(group.row, group.image, ws.camera, g);
    drop_unsound(g);
    g.column[kGradSum] = g.mean_2d_norm;
    g.column[kGradCount] = Pack16(1.0f);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      const uint32_t id = group.id[j];
      // Between the updates, not in one burst: a core waits for some two dozen lines at a time and then for all.
      ask_for(ws.visible[slots.next(j)]);
      if (job.trainable != nullptr && !job.trainable[id]) continue;
      adam.step(id, g.column[j]);
      if (ws.keeps_bounds) note_bounds(ws, id, job.rows + size_t(kRowWidth) * id);
      if (job.trained != nullptr && (job.counted == nullptr || job.counted[id])) ++job.trained[id];
    }
  });
}

void gradients(Workspace& ws, const GradientOutput& job, int thread) {
  const auto ask_for = [&](const Visible& splat) { prefetch(ws.rows + size_t(kRowWidth) * splat.id); };
  for_each_group(ws, thread, ask_for, [&](uint32_t segment, const Group& group, const Slots& slots) {
    ParameterGradients g;
    backward16<true>(group.row, group.image, ws.camera, g);
    drop_unsound(g);
    for (int k = 0; k < 6; ++k) {
      job.d_twist[6 * size_t(segment) + size_t(k)] += double(sum(keep(is_finite(g.twist[k]), g.twist[k])));
    }
    alignas(64) float norms[16];
    store(norms, g.mean_2d_norm);
    transpose(g.column);
    for (int j = 0; j < group.lanes; ++j) {
      ask_for(ws.visible[slots.next(j)]);
      store(job.d_rows + size_t(kRowWidth) * group.id[j], g.column[j]);
      job.mean_2d_norm[slots.first + uint32_t(j)] = norms[j];
    }
  });
}

}  // namespace gausslite::GAUSSLITE_ISA
