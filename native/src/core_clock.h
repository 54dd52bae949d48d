// SPDX-License-Identifier: Apache-2.0
// The clock frequency of the core, to convert times to cycles. The time stamp counter has another rate.
#pragma once

namespace gausslite {

// Measures the clock of the current core under load, in GHz; takes about a millisecond.
double core_clock_ghz();

}  // namespace gausslite
