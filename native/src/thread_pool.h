// SPDX-License-Identifier: Apache-2.0
// Persistent threads for stages of a few hundred microseconds each.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace gausslite {

// Waits until `value` differs from `old`, and returns it. The thread first spins, then yields, then sleeps: code that
// changes the value must also notify.
uint32_t wait_while(const std::atomic<uint32_t>& value, uint32_t old);

// One owner calls `run`; the calling thread is thread 0. Between two calls the other threads spin for a fraction of a
// millisecond, and then sleep.
class ThreadPool {
 public:
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  int size() const { return size_; }

  // Runs job(thread) on all threads and returns when all are done. Throws the first exception of a thread; the other
  // threads leave the job at their next barrier.
  template <class F>
  void run(const F& job) {
    run({&job, [](const void* job, int thread) { (*static_cast<const F*>(job))(thread); }});
  }

  // To call in a job: waits for all threads. The last one to arrive calls `last` before all continue.
  void barrier(const std::function<void()>& last = {});

 private:
  // A job of any type, without an allocation.
  struct Job {
    const void* job;
    void (*call)(const void* job, int thread);
  };

  void run(const Job& job);
  void worker_loop(int thread);
  void run_job(int thread);
  void join_all();

  int size_;
  std::vector<std::thread> threads_;
  Job job_{};
  bool quit_ = false;
  std::mutex error_mutex_;
  std::exception_ptr error_;  // the first one of this run
  std::atomic<bool> failed_{false};
  alignas(64) std::atomic<uint32_t> call_{0};
  alignas(64) std::atomic<uint32_t> running_{0};
  alignas(64) std::atomic<uint32_t> arrived_{0};
  alignas(64) std::atomic<uint32_t> generation_{0};
};

}  // namespace gausslite
