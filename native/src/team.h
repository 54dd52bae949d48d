// SPDX-License-Identifier: Apache-2.0
// A team of threads that stays alive between calls, for stages of a few hundred microseconds each.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
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

  // Runs job(member) on every member and returns when all are done. The job must not throw.
  void run(const std::function<void(int)>& job);

  // Inside a job: waits for all members. The last one to arrive calls `last` before the others go on.
  void barrier(const std::function<void()>& last = {});

 private:
  void serve(int member);

  int size_;
  std::vector<std::thread> threads_;
  const std::function<void(int)>* job_ = nullptr;
  bool quit_ = false;
  alignas(64) std::atomic<uint32_t> call_{0};
  alignas(64) std::atomic<uint32_t> running_{0};
  alignas(64) std::atomic<uint32_t> arrived_{0};
  alignas(64) std::atomic<uint32_t> generation_{0};
};

}  // namespace gausslite
