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

}  // namespace

void StripSchedule::start(int strips, int tapes) {
  strips_ = strips;
  next_draw_ = walks_taken_ = 0;
  free_tapes_.clear();
  for (int tape = tapes - 1; tape >= 0; --tape) free_tapes_.push_back(tape);
  tape_of_strip_.assign(size_t(strips), 0);
  derive_waits_.assign(size_t(strips) + 1, 2);
  derive_waits_.front() = derive_waits_.back() = 1;
  walk_waits_.assign(size_t(strips), 2);
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
    task.tape = tape_of_strip_[size_t(task.index)];
    ++walks_taken_;
  } else if (!derivable_.empty()) {
    task.kind = StripTask::kDerive;
    task.index = pop(derivable_);
  } else if (next_draw_ < strips_ && !free_tapes_.empty()) {
    task.kind = StripTask::kDraw;
    task.index = next_draw_++;
    task.tape = tape_of_strip_[size_t(task.index)] = pop(free_tapes_);
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
      free_tapes_.push_back(task.tape);
    }
  }
  changes_.fetch_add(1, std::memory_order_release);
  changes_.notify_all();
}

}  // namespace gausslite
