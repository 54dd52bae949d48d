// SPDX-License-Identifier: Apache-2.0
#include "dispatch.h"

namespace gausslite {

namespace {

struct Variant {
  const char* name;
  bool (*is_supported)();
  const Stages& (*stages)();
};

#if defined(GAUSSLITE_HAS_AVX2) || defined(GAUSSLITE_HAS_AVX512)
// Tests every instruction set that CMakeLists.txt enables for the variant: a virtual machine may hide any of them.
bool has_avx2() {
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
}
#endif

#if defined(GAUSSLITE_HAS_AVX512)
// tile_chunk.h uses vpcompressb, which moves the selected bytes of a register to its front. It is part of VBMI2 (Ice
// Lake, Zen 4 and later).
bool has_avx512() {
  return has_avx2() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
         __builtin_cpu_supports("avx512vbmi2");
}
#endif

constexpr Variant kVariants[] = {
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

std::vector<std::string> usable_variants() {
  std::vector<std::string> names;
  for (const Variant& variant : kVariants) {
    if (variant.is_supported()) names.emplace_back(variant.name);
  }
  return names;
}

const Stages* find_stages(const std::string& name) {
  for (const Variant& variant : kVariants) {
    if (name == variant.name && variant.is_supported()) return &variant.stages();
  }
  return nullptr;
}

}  // namespace gausslite
