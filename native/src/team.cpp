// SPDX-License-Identifier: Apache-2.0
#include "team.h"

namespace gausslite {

namespace {

// First plain loads, for some 0.1 ms: longer than the barriers of a balanced stage and than the pause between two calls
// of a loop. A PAUSE instruction would let a hypervisor take the processor away, which costs far more than the wait
// (0.2 ms a stage were seen), and yielding at once would hand it to another process for a whole time slice. Then the
// scheduler may run others: with fewer free cores than members, spinning on would only delay the member that is waited
// for. After another 0.2 ms or so the thread sleeps.
constexpr int kSpins = 200'000;
constexpr int kYields = 400;

// Leaves a job in which another member failed.
struct Left {};

}  // namespace

uint32_t wait_while(const std::atomic<uint32_t>& value, uint32_t old) {
  for (int i = 0; i < kSpins; ++i) {
    const uint32_t now = value.load(std::memory_order_acquire);
    if (now != old) return now;
  }
  for (int i = 0; i < kYields; ++i) {
    std::this_thread::yield();
    const uint32_t now = value.load(std::memory_order_acquire);
    if (now != old) return now;
  }
  value.wait(old, std::memory_order_acquire);
  return value.load(std::memory_order_acquire);
}

Team::Team(int threads) : size_(threads) {
  try {
    for (int member = 1; member < threads; ++member) threads_.emplace_back([this, member] { serve(member); });
  } catch (...) {
    dismiss();
    throw;
  }
}

Team::~Team() { dismiss(); }

void Team::dismiss() {
  quit_ = true;
  call_.fetch_add(1, std::memory_order_release);
  call_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

void Team::serve(int member) {
  // The first throw asks for memory of the thread's own, and a process that cannot have it is ended: so it comes now.
  try {
    throw Left{};
  } catch (const Left&) {
  }
  for (uint32_t seen = 0;;) {
    // The calls are counted one by one: `run` returns only after every member has finished, so none can be missed.
    seen = wait_while(call_, seen);
    if (quit_) return;
    attempt(member);
    if (running_.fetch_sub(1, std::memory_order_acq_rel) == 1) running_.notify_one();
  }
}

void Team::run(const Job& job) {
  job_ = job;
  arrived_.store(0, std::memory_order_relaxed);
  failed_.store(false, std::memory_order_relaxed);
  error_ = nullptr;
  running_.store(uint32_t(size_ - 1), std::memory_order_relaxed);
  if (size_ > 1) {
    call_.fetch_add(1, std::memory_order_release);
    call_.notify_all();
  }
  attempt(0);
  for (uint32_t left = running_.load(std::memory_order_acquire); left != 0;) left = wait_while(running_, left);
  if (error_) std::rethrow_exception(error_);
}

// A member that fails lets go of those who wait for it at a barrier.
void Team::attempt(int member) {
  try {
    job_.call(job_.job, member);
  } catch (const Left&) {
  } catch (...) {
    {
      const std::lock_guard lock(error_mutex_);
      if (!error_) error_ = std::current_exception();
    }
    failed_.store(true, std::memory_order_release);
    generation_.fetch_add(1, std::memory_order_release);
    generation_.notify_all();
  }
}

void Team::barrier(const std::function<void()>& last) {
  const uint32_t generation = generation_.load(std::memory_order_acquire);
  if (failed_.load(std::memory_order_acquire)) throw Left{};
  if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == uint32_t(size_)) {
    if (last) last();
    arrived_.store(0, std::memory_order_relaxed);
    generation_.fetch_add(1, std::memory_order_release);
    generation_.notify_all();
  } else {
    wait_while(generation_, generation);
    if (failed_.load(std::memory_order_acquire)) throw Left{};
  }
}

}  // namespace gausslite
