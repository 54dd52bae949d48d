// SPDX-License-Identifier: Apache-2.0
// Which part of a training step with SSIM can be done next. A strip is drawn; rows k of the SSIM squares can be derived
// once the strips k - 1 and k are drawn; a strip is walked back once rows k and k + 1 of the squares are derived. No
// part's result depends on who does it or when.
//
// What a thread has drawn is in its caches, so each one works on strips side by side: two begin beside each other,
// where as much lies above as below, and go one upwards and one downwards. Only there, and where it helps another one
// at the end, a thread reads what another one has written.
#pragma once

#include <atomic>
#include <cstdint>
#include <mutex>
#include <vector>

namespace gausslite {

// Tapes and rows of squares are kept in few places, which are numbered and used again.
struct StripTask {
  enum Kind { kDraw, kDerive, kWalkBack, kNone };
  Kind kind = kNone;
  int index = 0;            // of the strip, or of the row of squares
  int tapes[2] = {-1, -1};  // the strip's; to derive a row, those of the strips above and below it, -1 beyond the image
  int squares[2] = {-1, -1};  // the row's; to walk a strip back, those of the rows at its upper and lower half
};

class StripSchedule {
 public:
  // With so many there is always something that can be done: when nothing can be derived or walked back, only the last
  // strip that was drawn of each thread's is waited for, and its first until those beyond it have begun too.
  static int tape_places(int threads) { return 2 * threads; }
  // A row lies between two strips, one of which at least still has its tape.
  static int square_places(int tape_places) { return 2 * tape_places; }

  // `weights`: how much there is to do in each strip.
  void start(const std::vector<uint32_t>& weights, int threads, int tape_places);
  // Waits for a task for this thread; kNone when all are taken.
  StripTask next(int thread);
  void finish(const StripTask& task);
  // No more tasks for anybody: one of the threads cannot finish its own.
  void stop();

 private:
  // Strips of a thread that are not drawn yet: `next` and `left` - 1 behind it, upwards (-1) or downwards (1).
  struct Front {
    int next, left, step;
  };
  bool take(StripTask& task, int thread);
  StripTask draw(int thread);
  StripTask derive(int row);
  StripTask walk_back(int strip);
  // The latest on the stack that this thread has drawn, or that lies beside a strip that it has; -1 if there is none.
  int pop_own_strip(int thread);
  int pop_own_row(int thread);

  std::mutex mutex_;
  int strips_ = 0, not_drawn_ = 0, walks_taken_ = 0;
  std::vector<Front> fronts_;
  std::vector<int> edges_;  // [t]: above it, t threads' share of the work
  std::vector<int> free_tapes_, free_squares_, tape_of_strip_, squares_of_row_;
  std::vector<int> drawn_by_, tape_used_by_;    // threads: by strip, and by place
  std::vector<int> derive_waits_, walk_waits_;  // parts that are still missing
  std::vector<int> row_users_;                  // strips beside a row that are not walked back yet
  std::vector<int> derivable_, walkable_;
  std::atomic<uint32_t> changes_{0};
};

}  // namespace gausslite
