// SPDX-License-Identifier: Apache-2.0
#include "strip_schedule.h"

#include <algorithm>
#include <cstddef>
#include <numeric>

#include "team.h"

namespace gausslite {

namespace {

int pop(std::vector<int>& stack) {
  const int last = stack.back();
  stack.pop_back();
  return last;
}

// The latest number on the stack for which is_own holds; -1 if there is none.
template <class F>
int pop_own(std::vector<int>& stack, F is_own) {
  for (size_t i = stack.size(); i-- > 0;) {
    const int own = stack[i];
    if (!is_own(own)) continue;
    stack.erase(stack.begin() + std::ptrdiff_t(i));
    return own;
  }
  return -1;
}

// Numbers 0 ... count - 1, the lowest on top.
void fill(std::vector<int>& stack, int count) {
  stack.clear();
  for (int i = count - 1; i >= 0; --i) stack.push_back(i);
}

}  // namespace

void StripSchedule::start(const std::vector<uint32_t>& weights, int threads, int tape_places) {
  const int strips = int(weights.size());
  strips_ = not_drawn_ = strips;
  walks_taken_ = 0;
  edges_.assign(size_t(threads) + 1, strips);
  const uint64_t total = std::accumulate(weights.begin(), weights.end(), uint64_t{0});
  uint64_t above = 0;
  for (int strip = 0, t = 0; strip <= strips && t < threads; ++strip) {
    for (; t < threads && above * uint64_t(threads) >= total * uint64_t(t); ++t) edges_[size_t(t)] = strip;
    if (strip < strips) above += weights[size_t(strip)];
  }
  edges_[0] = 0;
  fronts_.clear();
  for (int t = 0; t < threads; ++t) {
    const int first = edges_[size_t(t)], count = edges_[size_t(t) + 1] - first;
    const bool upwards = t % 2 == 0 && t + 1 < threads;
    fronts_.push_back({upwards ? first + count - 1 : first, count, upwards ? -1 : 1});
  }
  fill(free_tapes_, tape_places);
  fill(free_squares_, square_places(tape_places));
  tape_of_strip_.assign(size_t(strips), -1);
  drawn_by_.assign(size_t(strips), -1);
  tape_used_by_.resize(size_t(tape_places), -1);
  squares_of_row_.assign(size_t(strips) + 1, -1);
  walk_waits_.assign(size_t(strips), 2);
  for (std::vector<int>* strips_beside : {&derive_waits_, &row_users_}) {
    strips_beside->assign(size_t(strips) + 1, 2);
    strips_beside->front() = strips_beside->back() = 1;
  }
  derivable_.clear();
  walkable_.clear();
}

StripTask StripSchedule::next(int thread) {
  for (;;) {
    const uint32_t seen = changes_.load(std::memory_order_acquire);
    {
      const std::lock_guard lock(mutex_);
      StripTask task;
      if (walks_taken_ == strips_ || take(task, thread)) return task;
    }
    wait_while(changes_, seen);
  }
}

// What lies in its own caches comes first, and walking back first of all: that frees a tape. What others have drawn a
// thread looks at only when nothing is left of its own strips.
bool StripSchedule::take(StripTask& task, int thread) {
  const bool can_draw = not_drawn_ > 0 && !free_tapes_.empty();
  if (const int strip = pop_own_strip(thread); strip >= 0) {
    task = walk_back(strip);
  } else if (const int row = pop_own_row(thread); row >= 0) {
    task = derive(row);
  } else if (can_draw && fronts_[size_t(thread)].left > 0) {
    task = draw(thread);
  } else if (!derivable_.empty()) {
    task = derive(pop(derivable_));
  } else if (!walkable_.empty()) {
    task = walk_back(pop(walkable_));
  } else if (can_draw) {
    task = draw(thread);
  } else {
    return false;
  }
  return true;
}

// Of its own strips the next one; when they are drawn, the next one of whoever has most left.
StripTask StripSchedule::draw(int thread) {
  Front* front = &fronts_[size_t(thread)];
  if (front->left == 0) {
    front = &*std::max_element(fronts_.begin(), fronts_.end(),
                               [](const Front& a, const Front& b) { return a.left < b.left; });
  }
  const int strip = front->next;
  front->next += front->step;
  --front->left;
  --not_drawn_;
  int tape = pop_own(free_tapes_, [&](int place) { return tape_used_by_[size_t(place)] == thread; });
  if (tape < 0) tape = pop(free_tapes_);
  tape_of_strip_[size_t(strip)] = tape;
  drawn_by_[size_t(strip)] = tape_used_by_[size_t(tape)] = thread;
  return {StripTask::kDraw, strip, {tape, -1}, {-1, -1}};
}

StripTask StripSchedule::derive(int row) {
  const int above = row > 0 ? tape_of_strip_[size_t(row - 1)] : -1;
  const int below = row < strips_ ? tape_of_strip_[size_t(row)] : -1;
  const int squares = squares_of_row_[size_t(row)] = pop(free_squares_);
  return {StripTask::kDerive, row, {above, below}, {squares, -1}};
}

StripTask StripSchedule::walk_back(int strip) {
  ++walks_taken_;
  return {StripTask::kWalkBack,
          strip,
          {tape_of_strip_[size_t(strip)], -1},
          {squares_of_row_[size_t(strip)], squares_of_row_[size_t(strip) + 1]}};
}

int StripSchedule::pop_own_strip(int thread) {
  return pop_own(walkable_, [&](int strip) { return drawn_by_[size_t(strip)] == thread; });
}

int StripSchedule::pop_own_row(int thread) {
  return pop_own(derivable_, [&](int row) {
    return (row > 0 && drawn_by_[size_t(row - 1)] == thread) || (row < strips_ && drawn_by_[size_t(row)] == thread);
  });
}

void StripSchedule::finish(const StripTask& task) {
  {
    const std::lock_guard lock(mutex_);
    if (task.kind == StripTask::kDraw) {
      for (const int k : {task.index, task.index + 1}) {
        if (--derive_waits_[size_t(k)] == 0) derivable_.push_back(k);
      }
    } else if (task.kind == StripTask::kDerive) {
      for (const int strip : {task.index - 1, task.index}) {
        if (strip >= 0 && strip < strips_ && --walk_waits_[size_t(strip)] == 0) walkable_.push_back(strip);
      }
    } else {
      free_tapes_.push_back(task.tapes[0]);
      for (const int k : {task.index, task.index + 1}) {
        if (--row_users_[size_t(k)] == 0) free_squares_.push_back(squares_of_row_[size_t(k)]);
      }
    }
  }
  changes_.fetch_add(1, std::memory_order_release);
  changes_.notify_all();
}

void StripSchedule::stop() {
  {
    const std::lock_guard lock(mutex_);
    walks_taken_ = strips_;
  }
  changes_.fetch_add(1, std::memory_order_release);
  changes_.notify_all();
}

}  // namespace gausslite
