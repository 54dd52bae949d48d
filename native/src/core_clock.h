// SPDX-License-Identifier: Apache-2.0
// The clock of the core, to report cycles: the time stamp counter has another rate.
#pragma once

namespace gausslite {

// Measures the clock of the current core under load, in GHz; takes about a millisecond.
double core_clock_ghz();

}  // namespace gausslite
