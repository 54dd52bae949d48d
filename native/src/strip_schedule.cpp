// SPDX-License-Identifier: Apache-2.0
#include "strip_schedule.h"

#include "team.h"

namespace gausslite {

namespace {

int pop(std::vector<int>& stack) {
  const int last = stack.back();
  stack.pop_back();
  return last;
}

// Numbers 0 ... count - 1, the lowest on top.
void fill(std::vector<int>& stack, int count) {
  stack.clear();
  for (int i = count - 1; i >= 0; --i) stack.push_back(i);
}

}  // namespace

void StripSchedule::start(int strips, int tape_places) {
  strips_ = strips;
  next_draw_ = walks_taken_ = 0;
  fill(free_tapes_, tape_places);
  fill(free_squares_, square_places(tape_places));
  tape_of_strip_.assign(size_t(strips), -1);
  squares_of_row_.assign(size_t(strips) + 1, -1);
  walk_waits_.assign(size_t(strips), 2);
  for (std::vector<int>* strips_beside : {&derive_waits_, &row_users_}) {
    strips_beside->assign(size_t(strips) + 1, 2);
    strips_beside->front() = strips_beside->back() = 1;
  }
  derivable_.clear();
  walkable_.clear();
}

StripTask StripSchedule::next() {
  for (;;) {
    const uint32_t seen = changes_.load(std::memory_order_acquire);
    {
      const std::lock_guard lock(mutex_);
      StripTask task;
      if (walks_taken_ == strips_ || take(task)) return task;
    }
    wait_while(changes_, seen);
  }
}

// Walking back comes first: it frees a tape, and the strip is the likeliest to be still in cache.
bool StripSchedule::take(StripTask& task) {
  if (!walkable_.empty()) {
    task.kind = StripTask::kWalkBack;
    task.index = pop(walkable_);
    task.tapes[0] = tape_of_strip_[size_t(task.index)];
    for (int i = 0; i < 2; ++i) task.squares[i] = squares_of_row_[size_t(task.index + i)];
    ++walks_taken_;
  } else if (!derivable_.empty()) {
    task.kind = StripTask::kDerive;
    task.index = pop(derivable_);
    if (task.index > 0) task.tapes[0] = tape_of_strip_[size_t(task.index - 1)];
    if (task.index < strips_) task.tapes[1] = tape_of_strip_[size_t(task.index)];
    task.squares[0] = squares_of_row_[size_t(task.index)] = pop(free_squares_);
  } else if (next_draw_ < strips_ && !free_tapes_.empty()) {
    task.kind = StripTask::kDraw;
    task.index = next_draw_++;
    task.tapes[0] = tape_of_strip_[size_t(task.index)] = pop(free_tapes_);
  } else {
    return false;
  }
  return true;
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

}  // namespace gausslite
