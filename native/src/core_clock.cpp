// SPDX-License-Identifier: Apache-2.0
#include "core_clock.h"

#include <algorithm>
#include <chrono>
#include <cstdint>

namespace gausslite {

namespace {

constexpr int kRuns = 8, kRounds = 30'000, kAddsPerRound = 16;

// Dependent additions take one cycle each. The addend comes from a register, because some cores fold constants away.
uint64_t add_in_a_chain(uint64_t sum, uint64_t addend) {
  for (int round = 0; round < kRounds; ++round) {
    for (int i = 0; i < kAddsPerRound; ++i) {
      sum += addend;
      asm volatile("" : "+r"(sum), "+r"(addend));
    }
  }
  return sum;
}

}  // namespace

double core_clock_ghz() {
  using Clock = std::chrono::steady_clock;
  double min_ns = 1e18;
  for (int run = 0; run < kRuns; ++run) {
    const auto started = Clock::now();
    volatile uint64_t kept = add_in_a_chain(uint64_t(run), 3);
    (void)kept;
    min_ns = std::min(min_ns, std::chrono::duration<double, std::nano>(Clock::now() - started).count());
  }
  return double(kRounds) * kAddsPerRound / min_ns;
}

}  // namespace gausslite
