// SPDX-License-Identifier: Apache-2.0
#include "thread_pool.h"

namespace gausslite {

namespace {

// The wait has three phases: about 0.1 ms of plain loads, about 0.2 ms of yields, then sleep. The first is longer than
// most waits at a barrier and between two calls of a loop. It has no PAUSE instruction, which would let a hypervisor
// take the processor away, at a measured cost of 0.2 ms per stage. It has no yield either, which would give the
// processor to another process for a time slice. The second phase serves machines with fewer free cores than threads:
// spinning would delay the thread that the others wait for.
constexpr int kSpins = 200'000;
constexpr int kYields = 400;

// Thrown to leave a job after another thread failed.
struct JobAborted {};

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

ThreadPool::ThreadPool(int threads) : size_(threads) {
  try {
    for (int thread = 1; thread < threads; ++thread) threads_.emplace_back([this, thread] { worker_loop(thread); });
  } catch (...) {
    join_all();
    throw;
  }
}

ThreadPool::~ThreadPool() { join_all(); }

void ThreadPool::join_all() {
  quit_ = true;
  call_.fetch_add(1, std::memory_order_release);
  call_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

void ThreadPool::worker_loop(int thread) {
  // The first throw of a thread allocates memory, and the process ends if that fails. So each thread throws once at its
  // start.
  try {
    throw JobAborted{};
  } catch (const JobAborted&) {
  }
  for (uint32_t last_call = 0;;) {
    // `run` returns after all threads have finished, so that no thread can miss a call.
    last_call = wait_while(call_, last_call);
    if (quit_) return;
    run_job(thread);
    if (running_.fetch_sub(1, std::memory_order_acq_rel) == 1) running_.notify_one();
  }
}

void ThreadPool::run(const Job& job) {
  job_ = job;
  arrived_.store(0, std::memory_order_relaxed);
  failed_.store(false, std::memory_order_relaxed);
  error_ = nullptr;
  running_.store(uint32_t(size_ - 1), std::memory_order_relaxed);
  if (size_ > 1) {
    call_.fetch_add(1, std::memory_order_release);
    call_.notify_all();
  }
  run_job(0);
  for (uint32_t left = running_.load(std::memory_order_acquire); left != 0;) left = wait_while(running_, left);
  if (error_) std::rethrow_exception(error_);
}

// A failed thread releases the threads that wait at a barrier.
void ThreadPool::run_job(int thread) {
  try {
    job_.call(job_.job, thread);
  } catch (const JobAborted&) {
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

void ThreadPool::barrier(const std::function<void()>& last) {
  const uint32_t generation = generation_.load(std::memory_order_acquire);
  if (failed_.load(std::memory_order_acquire)) throw JobAborted{};
  if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == uint32_t(size_)) {
    if (last) last();
    arrived_.store(0, std::memory_order_relaxed);
    generation_.fetch_add(1, std::memory_order_release);
    generation_.notify_all();
  } else {
    wait_while(generation_, generation);
    if (failed_.load(std::memory_order_acquire)) throw JobAborted{};
  }
}

}  // namespace gausslite
