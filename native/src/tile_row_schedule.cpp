// SPDX-License-Identifier: Apache-2.0
#include "tile_row_schedule.h"

#include <algorithm>
#include <cstddef>
#include <numeric>

#include "thread_pool.h"

namespace gausslite {

namespace {

int pop(std::vector<int>& stack) {
  const int last = stack.back();
  stack.pop_back();
  return last;
}

// Removes and returns the latest number on the stack for which is_own holds; -1 if there is none.
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

// Fills the stack with 0 ... count - 1, the lowest on top.
void fill(std::vector<int>& stack, int count) {
  stack.clear();
  for (int i = count - 1; i >= 0; --i) stack.push_back(i);
}

}  // namespace

void TileRowSchedule::start(const std::vector<uint32_t>& key_counts, int threads, int cache_slots) {
  const int tile_rows = int(key_counts.size());
  tile_rows_ = not_rendered_ = tile_rows;
  backward_taken_ = 0;
  first_tile_row_.assign(size_t(threads) + 1, tile_rows);
  const uint64_t total = std::accumulate(key_counts.begin(), key_counts.end(), uint64_t{0});
  // Thread t starts at the first tile row with at least its share t / threads of all keys above it.
  uint64_t keys_above = 0;
  for (int tile_row = 0, t = 0; tile_row <= tile_rows && t < threads; ++tile_row) {
    for (; t < threads && keys_above * uint64_t(threads) >= total * uint64_t(t); ++t)
      first_tile_row_[size_t(t)] = tile_row;
    if (tile_row < tile_rows) keys_above += key_counts[size_t(tile_row)];
  }
  first_tile_row_[0] = 0;
  ranges_.clear();
  for (int t = 0; t < threads; ++t) {
    const int first = first_tile_row_[size_t(t)], count = first_tile_row_[size_t(t) + 1] - first;
    // Threads 2 i and 2 i + 1 start at their common boundary, so that the rows that wait for each other there are
    // rendered first. A last thread without a partner goes to the bottom.
    const bool towards_top = t % 2 == 0 && t + 1 < threads;
    ranges_.push_back({towards_top ? first + count - 1 : first, count, towards_top ? -1 : 1});
  }
  fill(free_caches_, cache_slots);
  fill(free_squares_, square_slots(cache_slots));
  cache_of_tile_row_.assign(size_t(tile_rows), -1);
  rendered_by_.assign(size_t(tile_rows), -1);
  last_thread_of_cache_.resize(size_t(cache_slots), -1);
  squares_of_square_row_.assign(size_t(tile_rows) + 1, -1);
  missing_square_rows_.assign(size_t(tile_rows), 2);
  // A row of SSIM squares k spans the lower half of tile row k - 1 and the upper half of tile row k. It needs both, and
  // both need it. The first and the last row of squares have one tile row only.
  for (std::vector<int>* adjacent_tile_rows : {&missing_tile_rows_, &square_row_users_}) {
    adjacent_tile_rows->assign(size_t(tile_rows) + 1, 2);
    adjacent_tile_rows->front() = adjacent_tile_rows->back() = 1;
  }
  ssim_ready_.clear();
  backward_ready_.clear();
}

TileRowTask TileRowSchedule::next(int thread) {
  for (;;) {
    const uint32_t old_count = change_count_.load(std::memory_order_acquire);
    {
      const std::lock_guard lock(mutex_);
      TileRowTask task;
      if (backward_taken_ == tile_rows_ || take(task, thread)) return task;
    }
    wait_while(change_count_, old_count);
  }
}

// Tasks on data in the thread's own caches come first, and of these the backward tasks, which free a forward cache. A
// thread takes tasks on tile rows of other threads when none of its own are left.
//
// Returns false if nothing can be taken now. There is no deadlock, because then a task of another thread is running,
// and its end makes others ready. Suppose that no task is ready or running. Then each forward cache in use holds a
// rendered tile row next to one that is not rendered. The rendered rows of each range are contiguous, whoever
// rendered them, and those of ranges 2 i and 2 i + 1 form one block. A block has at most two ends next to rows that are
// not rendered, and each end holds one cache. So at most threads + 1 caches are in use, or one by a single thread,
// which starts at the top. These are fewer than cache_slots, so that a row can be rendered.
bool TileRowSchedule::take(TileRowTask& task, int thread) {
  const bool can_render = not_rendered_ > 0 && !free_caches_.empty();
  if (const int tile_row = pop_own_tile_row(thread); tile_row >= 0) {
    task = backward_task(tile_row);
  } else if (const int square_row = pop_own_square_row(thread); square_row >= 0) {
    task = ssim_task(square_row);
  } else if (can_render && ranges_[size_t(thread)].left > 0) {
    task = render_task(thread);
  } else if (!ssim_ready_.empty()) {
    task = ssim_task(pop(ssim_ready_));
  } else if (!backward_ready_.empty()) {
    task = backward_task(pop(backward_ready_));
  } else if (can_render) {
    task = render_task(thread);
  } else {
    return false;
  }
  return true;
}

// Takes the next of the thread's own tile rows; if none are left, the next of the thread with most rows left.
TileRowTask TileRowSchedule::render_task(int thread) {
  ThreadRange* range = &ranges_[size_t(thread)];
  if (range->left == 0) {
    range = &*std::max_element(ranges_.begin(), ranges_.end(),
                               [](const ThreadRange& a, const ThreadRange& b) { return a.left < b.left; });
  }
  const int tile_row = range->next;
  range->next += range->step;
  --range->left;
  --not_rendered_;
  int cache = pop_own(free_caches_, [&](int candidate) { return last_thread_of_cache_[size_t(candidate)] == thread; });
  if (cache < 0) cache = pop(free_caches_);
  cache_of_tile_row_[size_t(tile_row)] = cache;
  rendered_by_[size_t(tile_row)] = last_thread_of_cache_[size_t(cache)] = thread;
  return {TileRowTask::kRender, tile_row, {cache, -1}, {-1, -1}};
}

TileRowTask TileRowSchedule::ssim_task(int square_row) {
  const int above = square_row > 0 ? cache_of_tile_row_[size_t(square_row - 1)] : -1;
  const int below = square_row < tile_rows_ ? cache_of_tile_row_[size_t(square_row)] : -1;
  const int squares = squares_of_square_row_[size_t(square_row)] = pop(free_squares_);
  return {TileRowTask::kSsim, square_row, {above, below}, {squares, -1}};
}

TileRowTask TileRowSchedule::backward_task(int tile_row) {
  ++backward_taken_;
  return {TileRowTask::kBackward,
          tile_row,
          {cache_of_tile_row_[size_t(tile_row)], -1},
          {squares_of_square_row_[size_t(tile_row)], squares_of_square_row_[size_t(tile_row) + 1]}};
}

int TileRowSchedule::pop_own_tile_row(int thread) {
  return pop_own(backward_ready_, [&](int tile_row) { return rendered_by_[size_t(tile_row)] == thread; });
}

int TileRowSchedule::pop_own_square_row(int thread) {
  return pop_own(ssim_ready_, [&](int square_row) {
    return (square_row > 0 && rendered_by_[size_t(square_row - 1)] == thread) ||
           (square_row < tile_rows_ && rendered_by_[size_t(square_row)] == thread);
  });
}

void TileRowSchedule::finish(const TileRowTask& task) {
  {
    const std::lock_guard lock(mutex_);
    if (task.kind == TileRowTask::kRender) {
      for (const int k : {task.index, task.index + 1}) {
        if (--missing_tile_rows_[size_t(k)] == 0) ssim_ready_.push_back(k);
      }
    } else if (task.kind == TileRowTask::kSsim) {
      for (const int tile_row : {task.index - 1, task.index}) {
        if (tile_row >= 0 && tile_row < tile_rows_ && --missing_square_rows_[size_t(tile_row)] == 0)
          backward_ready_.push_back(tile_row);
      }
    } else {
      free_caches_.push_back(task.caches[0]);
      for (const int k : {task.index, task.index + 1}) {
        if (--square_row_users_[size_t(k)] == 0) free_squares_.push_back(squares_of_square_row_[size_t(k)]);
      }
    }
  }
  change_count_.fetch_add(1, std::memory_order_release);
  change_count_.notify_all();
}

void TileRowSchedule::stop() {
  {
    const std::lock_guard lock(mutex_);
    backward_taken_ = tile_rows_;
  }
  change_count_.fetch_add(1, std::memory_order_release);
  change_count_.notify_all();
}

}  // namespace gausslite
