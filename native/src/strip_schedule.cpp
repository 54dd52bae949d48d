// SPDX-License-Identifier: Apache-2.0
#include "strip_schedule.h"

#include <cstddef>

#include "team.h"

namespace gausslite {

namespace {

int pop(std::vector<int>& stack) {
  const int last = stack.back();
  stack.pop_back();
  return last;
}

// The latest number on the stack that belongs to this thread; -1 if none does.
int pop_own(std::vector<int>& stack, const std::vector<int>& thread_of, int thread) {
  for (size_t i = stack.size(); i-- > 0;) {
    const int own = stack[i];
    if (thread_of[size_t(own)] != thread) continue;
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

void StripSchedule::start(int strips, int tape_places) {
  strips_ = strips;
  next_draw_ = walks_taken_ = 0;
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

// A thread first walks back what it has drawn itself: that frees a tape, and the tape is in its caches. What another
// one has drawn it walks back only when there is nothing else to do.
bool StripSchedule::take(StripTask& task, int thread) {
  int strip = pop_own(walkable_, drawn_by_, thread);
  if (strip < 0 && !derivable_.empty()) {
    task.kind = StripTask::kDerive;
    task.index = pop(derivable_);
    if (task.index > 0) task.tapes[0] = tape_of_strip_[size_t(task.index - 1)];
    if (task.index < strips_) task.tapes[1] = tape_of_strip_[size_t(task.index)];
    task.squares[0] = squares_of_row_[size_t(task.index)] = pop(free_squares_);
    return true;
  }
  if (strip < 0 && next_draw_ < strips_ && !free_tapes_.empty()) {
    const int own_tape = pop_own(free_tapes_, tape_used_by_, thread),
              tape = own_tape >= 0 ? own_tape : pop(free_tapes_);
    task.kind = StripTask::kDraw;
    task.index = next_draw_++;
    task.tapes[0] = tape_of_strip_[size_t(task.index)] = tape;
    drawn_by_[size_t(task.index)] = tape_used_by_[size_t(tape)] = thread;
    return true;
  }
  if (strip < 0 && !walkable_.empty()) strip = pop(walkable_);
  if (strip < 0) return false;
  task.kind = StripTask::kWalkBack;
  task.index = strip;
  task.tapes[0] = tape_of_strip_[size_t(strip)];
  for (int i = 0; i < 2; ++i) task.squares[i] = squares_of_row_[size_t(strip + i)];
  ++walks_taken_;
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
