// SPDX-License-Identifier: Apache-2.0
// Sixteen floats at once: includes the SIMD variant of this translation unit and adds the functions that all variants
// share.
//
// The build compiles every stage once per variant and defines GAUSSLITE_ISA as its name. This is also the namespace of
// its code, so that one extension module can contain all variants.
#pragma once

#ifndef GAUSSLITE_ISA
#error "GAUSSLITE_ISA is not defined: stages are compiled by native/CMakeLists.txt, once per instruction set"
#endif

#define GAUSSLITE_INLINE inline __attribute__((always_inline))

#if defined(GAUSSLITE_USE_AVX512)
#include "simd/pack_avx512.h"
#elif defined(GAUSSLITE_USE_AVX2)
#include "simd/pack_avx2.h"
#elif defined(GAUSSLITE_USE_NEON)
#include "simd/pack_neon.h"
#else
#include "simd/pack_portable.h"
#endif

namespace gausslite::GAUSSLITE_ISA {

constexpr float kLog2E = 1.44269504088896f;
constexpr float kLn2 = 0.69314718055994531f;

// 2^e for e from -126 to 127, to a relative error of at most 3.6e-6. With n = kExp2TableSize, 2^e = 2^(k / n) 2^f for
// the integer k nearest to n e: k steps of 1 / n, and a remainder f. Adding a large bias to e rounds e to k / n and
// puts k into the lowest mantissa bits. A polynomial computes 2^f; its degree depends on n.
GAUSSLITE_INLINE Pack16 exp2_fast(Pack16 e) {
  const Pack16 bias(12582912.0f / kExp2TableSize), biased_steps = e + bias, f = e - (biased_steps - bias);
  Pack16 p;
  if constexpr (kExp2TableSize == 16) {
    p = fma(Pack16(0.24021946f), f, Pack16(0.69318783f));
    p = fma(p, f, Pack16(1.0f));
  } else if constexpr (kExp2TableSize == 8) {
    p = fma(Pack16(0.24019833f), f, Pack16(0.69330977f));
    p = fma(p, f, Pack16(1.00000011f));
  } else {
    p = fma(Pack16(0.0095701f), f, Pack16(0.05591786f));
    p = fma(p, f, Pack16(0.24024745f));
    p = fma(p, f, Pack16(0.69312181f));
    p = fma(p, f, Pack16(0.99999926f));
  }
  return p * exp2_of_steps(biased_steps);
}

// 2^e of any e, to a relative error of 7.5e-8, by a polynomial of degree 5.
GAUSSLITE_INLINE Pack16 exp2_fine(Pack16 e) {
  const Pack16 f = fraction(e);
  Pack16 p = fma(Pack16(0.0018775766948238015f), f, Pack16(0.008989340625703335f));
  p = fma(p, f, Pack16(0.05582631751894951f));
  p = fma(p, f, Pack16(0.24015361070632935f));
  p = fma(p, f, Pack16(0.6931530833244324f));
  p = fma(p, f, Pack16(0.9999999403953552f));
  return multiply_by_power_of_two(p, e);
}

GAUSSLITE_INLINE Pack16 exp(Pack16 x) { return exp2_fine(x * kLog2E); }

// log2(x) of positive normal x to an absolute error of 2e-7.
GAUSSLITE_INLINE Pack16 log2(Pack16 x) {
  const Pack16 m = mantissa(x) - 1.0f;
  Pack16 p = fma(Pack16(-0.012370623648166656f), m, Pack16(0.06378752738237381f));
  p = fma(p, m, Pack16(-0.15559986233711243f));
  p = fma(p, m, Pack16(0.2561796307563782f));
  p = fma(p, m, Pack16(-0.3534546494483948f));
  p = fma(p, m, Pack16(0.4800737500190735f));
  p = fma(p, m, Pack16(-0.7213107347488403f));
  p = fma(p, m, Pack16(1.4426947832107544f));
  return fma(p, m, exponent(x));
}

// True for numbers that are neither NaN nor infinite: only these give 0 when multiplied by 0.
GAUSSLITE_INLINE Mask16 is_finite(Pack16 x) { return x * 0.0f == Pack16(0.0f); }

GAUSSLITE_INLINE Mask16 first_lanes(int n) { return mask_of((1u << n) - 1u); }

// Transposes a 16x16 matrix in place: first within quads, then whole quads.
GAUSSLITE_INLINE void transpose(Pack16 (&r)[16]) {
  for (int i = 0; i < 16; i += 4) transpose_within_quads(r[i], r[i + 1], r[i + 2], r[i + 3]);
  for (int i = 0; i < 4; ++i) transpose_whole_quads(r[i], r[i + 4], r[i + 8], r[i + 12]);
}

GAUSSLITE_INLINE void prefetch(const void* p) { __builtin_prefetch(p, 0, 3); }
// Prefetch for writing: takes the cache line from other cores before the store.
GAUSSLITE_INLINE void prefetch_to_write(const void* p) { __builtin_prefetch(p, 1, 3); }

}  // namespace gausslite::GAUSSLITE_ISA
