// SPDX-License-Identifier: Apache-2.0
// A team of threads that stays alive between calls, for stages of a few hundred microseconds each.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace gausslite {

// Waits until `value` is no longer `old` and returns it: first spinning, then yielding, then asleep, so that whoever
// changes the value must also notify.
uint32_t wait_while(const std::atomic<uint32_t>& value, uint32_t old);

// One owner calls `run`; the calling thread is member 0. A busy loop of calls pays nothing for waking up, and an idle
// team costs nothing.
class Team {
 public:
  explicit Team(int threads);
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return size_; }

  // Runs job(member) on every member and returns when all are done. Throws what the first member threw that did; the
  // others then leave the job at their next barrier.
  template <class F>
  void run(const F& job) {
    run({&job, [](const void* job, int member) { (*static_cast<const F*>(job))(member); }});
  }

  // Inside a job: waits for all members. The last one to arrive calls `last` before the others go on.
  void barrier(const std::function<void()>& last = {});

 private:
  // A call to a job of any type, which allocates nothing.
  struct Job {
    const void* job;
    void (*call)(const void* job, int member);
  };

  void run(const Job& job);
  void serve(int member);
  void attempt(int member);
  void dismiss();

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
