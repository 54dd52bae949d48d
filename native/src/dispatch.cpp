// SPDX-License-Identifier: Apache-2.0
#include "dispatch.h"

namespace gausslite {

namespace {

struct Form {
  const char* name;
  bool (*runs_here)();
  const Stages& (*stages)();
};

#if defined(GAUSSLITE_HAS_AVX2) || defined(GAUSSLITE_HAS_AVX512)
// All that CMakeLists.txt lets the compiler use: a virtual machine may lack any of it.
bool has_avx2() {
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
}
#endif

#if defined(GAUSSLITE_HAS_AVX512)
// VBMI2 (Ice Lake and Zen 4 onwards) brings the byte compression that builds the block lists.
bool has_avx512() {
  return has_avx2() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
         __builtin_cpu_supports("avx512vbmi2");
}
#endif

constexpr Form kForms[] = {
#if defined(GAUSSLITE_HAS_AVX512)
    {"avx512", has_avx512, avx512::stages},
#endif
#if defined(GAUSSLITE_HAS_AVX2)
    {"avx2", has_avx2, avx2::stages},
#endif
#if defined(GAUSSLITE_HAS_NEON)
    {"neon", [] { return true; }, neon::stages},
#endif
    {"portable", [] { return true; }, portable::stages},
};

}  // namespace

std::vector<std::string> usable_forms() {
  std::vector<std::string> names;
  for (const Form& form : kForms) {
    if (form.runs_here()) names.emplace_back(form.name);
  }
  return names;
}

const Stages* find_stages(const std::string& name) {
  for (const Form& form : kForms) {
    if (name == form.name && form.runs_here()) return &form.stages();
  }
  return nullptr;
}

}  // namespace gausslite
