// SPDX-License-Identifier: Apache-2.0
// Eight floats in one AVX register, for the AVX2 and AVX-512 variants.
#pragma once

#include <immintrin.h>

#include <cstdint>
#include <cstring>

namespace gausslite::GAUSSLITE_ISA {

struct Pack8 {
  __m256 v;
  Pack8() = default;
  GAUSSLITE_INLINE Pack8(__m256 x) : v(x) {}
  GAUSSLITE_INLINE Pack8(float x) : v(_mm256_set1_ps(x)) {}
};

GAUSSLITE_INLINE Pack8 load8(const float* p) { return _mm256_loadu_ps(p); }
GAUSSLITE_INLINE void store8(float* p, Pack8 a) { _mm256_storeu_ps(p, a.v); }
GAUSSLITE_INLINE Pack8 broadcast_pair(const float* p) {
  return _mm256_castpd_ps(_mm256_broadcast_sd(reinterpret_cast<const double*>(p)));
}
GAUSSLITE_INLINE Pack8 operator+(Pack8 a, Pack8 b) { return _mm256_add_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack8 operator-(Pack8 a, Pack8 b) { return _mm256_sub_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack8 operator*(Pack8 a, Pack8 b) { return _mm256_mul_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack8 fma(Pack8 a, Pack8 b, Pack8 c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
GAUSSLITE_INLINE Pack8 fnma(Pack8 a, Pack8 b, Pack8 c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }

template <int a, int b, int c, int d, int e, int f, int g, int h>
GAUSSLITE_INLINE Pack8 permute(Pack8 x) {
  return _mm256_permutevar8x32_ps(x.v, _mm256_setr_epi32(a, b, c, d, e, f, g, h));
}

// Four rows of four bytes.
GAUSSLITE_INLINE __m128i byte_block(const uint8_t* p, int64_t stride) {
  int32_t row[4];
  for (int i = 0; i < 4; ++i) std::memcpy(&row[i], p + i * stride, sizeof row[i]);
  return _mm_setr_epi32(row[0], row[1], row[2], row[3]);
}

}  // namespace gausslite::GAUSSLITE_ISA
