// SPDX-License-Identifier: Apache-2.0
// Order of the tasks of a training step with SSIM. Each tile row is rendered. Row k of the SSIM squares needs the
// rendered tile rows k - 1 and k. The backward pass of tile row s needs rows s and s + 1 of the squares. No result
// depends on the thread or the order of the tasks.
//
// A rendered tile row is in its thread's caches, so each thread works on adjacent tile rows. Threads 2 i and 2 i + 1
// start at adjacent rows and proceed upwards and downwards, with equal work. A thread reads data of other threads only
// at these boundaries, and where it helps another thread at the end.
#pragma once

#include <atomic>
#include <cstdint>
#include <mutex>
#include <vector>

namespace gausslite {

// One task. Forward caches and rows of SSIM squares are few and reused; the task holds their indices.
struct TileRowTask {
  enum Kind { kRender, kSsim, kBackward, kNone };
  Kind kind = kNone;
  // The tile row; for kSsim, the row of SSIM squares.
  int index = 0;
  // Forward cache of the tile row; for kSsim, those of the tile rows above and below, -1 beyond the image.
  int caches[2] = {-1, -1};
  // Memory of the row of SSIM squares; for kBackward, of the rows that overlap the upper and lower half of the tile
  // row.
  int squares[2] = {-1, -1};
};

class TileRowSchedule {
 public:
  // Number of forward caches: two per thread avoid deadlock (see `take`).
  static int cache_slots(int threads) { return 2 * threads; }
  // Number of rows of SSIM squares in memory: at most two for each forward cache in use. A row of squares is in use
  // only while one of the two tile rows that it overlaps has a forward cache.
  static int square_slots(int cache_slots) { return 2 * cache_slots; }

  // `key_counts`: the number of depth keys of each tile row.
  void start(const std::vector<uint32_t>& key_counts, int threads, int cache_slots);
  // Waits for a task for this thread; returns kNone if all are taken.
  TileRowTask next(int thread);
  // Marks a task as finished, so that tasks that need its result become ready.
  void finish(const TileRowTask& task);
  // Ends the schedule for all threads, after one of them failed.
  void stop();

 private:
  // Tile rows of a thread that are not rendered yet: `left` rows from `next` on, towards the top of the image (step -1)
  // or the bottom (1).
  struct ThreadRange {
    int next, left, step;
  };
  bool take(TileRowTask& task, int thread);
  TileRowTask render_task(int thread);
  TileRowTask ssim_task(int square_row);
  TileRowTask backward_task(int tile_row);
  // The latest ready tile row that this thread rendered, or row of squares next to such a tile row; -1 if there is
  // none.
  int pop_own_tile_row(int thread);
  int pop_own_square_row(int thread);

  std::mutex mutex_;
  int tile_rows_ = 0, not_rendered_ = 0, backward_taken_ = 0;
  std::vector<ThreadRange> ranges_;
  std::vector<int> first_tile_row_;  // [t]: first tile row of thread t; each thread has an equal share of the keys
  std::vector<int> free_caches_, free_squares_, cache_of_tile_row_, squares_of_square_row_;
  std::vector<int> rendered_by_, last_thread_of_cache_;  // threads, by tile row and by forward cache
  std::vector<int> missing_tile_rows_;                   // [row of squares]: adjacent tile rows not rendered yet
  std::vector<int> missing_square_rows_;                 // [tile row]: overlapping rows of squares without SSIM yet
  std::vector<int> square_row_users_;                    // tile rows that still need a row of squares
  std::vector<int> ssim_ready_, backward_ready_;
  std::atomic<uint32_t> change_count_{0};
};

}  // namespace gausslite
