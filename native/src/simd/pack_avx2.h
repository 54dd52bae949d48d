// SPDX-License-Identifier: Apache-2.0
// Sixteen floats in two AVX registers (AVX2 and FMA). pack_portable.h documents the functions.
#pragma once

#include <immintrin.h>

#include <cstdint>

#include "simd/pack8_avx.h"

namespace gausslite::GAUSSLITE_ISA {

constexpr bool kFitsOneRegister = false;

struct Mask16 {
  __m256 lo, hi;
};

GAUSSLITE_INLINE Mask16 operator&(Mask16 a, Mask16 b) { return {_mm256_and_ps(a.lo, b.lo), _mm256_and_ps(a.hi, b.hi)}; }
GAUSSLITE_INLINE Mask16 operator|(Mask16 a, Mask16 b) { return {_mm256_or_ps(a.lo, b.lo), _mm256_or_ps(a.hi, b.hi)}; }
GAUSSLITE_INLINE uint32_t bits(Mask16 m) {
  return uint32_t(_mm256_movemask_ps(m.lo)) | uint32_t(_mm256_movemask_ps(m.hi)) << 8;
}
GAUSSLITE_INLINE bool any(Mask16 m) { return _mm256_movemask_ps(_mm256_or_ps(m.lo, m.hi)) != 0; }
GAUSSLITE_INLINE Mask16 mask_of(uint32_t bits) {
  const __m256i all = _mm256_set1_epi32(int(bits));
  const __m256i lo = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128), hi = _mm256_slli_epi32(lo, 8);
  return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, lo), lo)),
          _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, hi), hi))};
}

struct Pack16 {
  __m256 lo, hi;
  Pack16() = default;
  // Copy each half: GCC would copy a 64-byte block through memory and general registers.
  GAUSSLITE_INLINE Pack16(const Pack16& other) : lo(other.lo), hi(other.hi) {}
  GAUSSLITE_INLINE Pack16& operator=(const Pack16& other) {
    lo = other.lo;
    hi = other.hi;
    return *this;
  }
  GAUSSLITE_INLINE Pack16(__m256 a, __m256 b) : lo(a), hi(b) {}
  GAUSSLITE_INLINE Pack16(float x) : lo(_mm256_set1_ps(x)), hi(lo) {}
};

GAUSSLITE_INLINE Pack16 load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
GAUSSLITE_INLINE void store(float* p, Pack16 a) {
  _mm256_storeu_ps(p, a.lo);
  _mm256_storeu_ps(p + 8, a.hi);
}
GAUSSLITE_INLINE void store_int(int32_t* p, Pack16 a) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm256_cvttps_epi32(a.lo));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + 8), _mm256_cvttps_epi32(a.hi));
}

#define GAUSSLITE_LANEWISE(name, op) \
  GAUSSLITE_INLINE Pack16 name(Pack16 a, Pack16 b) { return {op(a.lo, b.lo), op(a.hi, b.hi)}; }
GAUSSLITE_LANEWISE(operator+, _mm256_add_ps)
GAUSSLITE_LANEWISE(operator-, _mm256_sub_ps)
GAUSSLITE_LANEWISE(operator*, _mm256_mul_ps)
GAUSSLITE_LANEWISE(operator/, _mm256_div_ps)
GAUSSLITE_LANEWISE(min, _mm256_min_ps)
GAUSSLITE_LANEWISE(max, _mm256_max_ps)
#undef GAUSSLITE_LANEWISE

GAUSSLITE_INLINE Pack16 operator-(Pack16 a) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_xor_ps(a.lo, sign), _mm256_xor_ps(a.hi, sign)};
}
GAUSSLITE_INLINE Pack16 fma(Pack16 a, Pack16 b, Pack16 c) {
  return {_mm256_fmadd_ps(a.lo, b.lo, c.lo), _mm256_fmadd_ps(a.hi, b.hi, c.hi)};
}
GAUSSLITE_INLINE Pack16 fnma(Pack16 a, Pack16 b, Pack16 c) {
  return {_mm256_fnmadd_ps(a.lo, b.lo, c.lo), _mm256_fnmadd_ps(a.hi, b.hi, c.hi)};
}
GAUSSLITE_INLINE Pack16 abs(Pack16 a) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(sign, a.lo), _mm256_andnot_ps(sign, a.hi)};
}
GAUSSLITE_INLINE Pack16 sqrt(Pack16 a) { return {_mm256_sqrt_ps(a.lo), _mm256_sqrt_ps(a.hi)}; }
GAUSSLITE_INLINE Pack16 floor(Pack16 a) { return {_mm256_floor_ps(a.lo), _mm256_floor_ps(a.hi)}; }
GAUSSLITE_INLINE Pack16 ceil(Pack16 a) { return {_mm256_ceil_ps(a.lo), _mm256_ceil_ps(a.hi)}; }

// rcpps and rsqrtps have a precision of 12 bits; one Newton step doubles it.
GAUSSLITE_INLINE Pack16 reciprocal(Pack16 a) {
  const Pack16 r{_mm256_rcp_ps(a.lo), _mm256_rcp_ps(a.hi)};
  return r * fnma(a, r, Pack16(2.0f));
}
// The 12 bits without the Newton step do not suffice.
GAUSSLITE_INLINE Pack16 rough_reciprocal(Pack16 a) { return reciprocal(a); }
GAUSSLITE_INLINE Pack16 rough_inverse_sqrt(Pack16 a) {
  // Not a * 0.5f: half of the smallest normal float is subnormal, which is slow to multiply.
  const Pack16 r{_mm256_rsqrt_ps(a.lo), _mm256_rsqrt_ps(a.hi)};
  return r * fnma(a * r, r * 0.5f, Pack16(1.5f));
}

#define GAUSSLITE_COMPARISON(name, predicate)                                            \
  GAUSSLITE_INLINE Mask16 name(Pack16 a, Pack16 b) {                                     \
    return {_mm256_cmp_ps(a.lo, b.lo, predicate), _mm256_cmp_ps(a.hi, b.hi, predicate)}; \
  }
GAUSSLITE_COMPARISON(operator<, _CMP_LT_OQ)
GAUSSLITE_COMPARISON(operator<=, _CMP_LE_OQ)
GAUSSLITE_COMPARISON(operator>, _CMP_GT_OQ)
GAUSSLITE_COMPARISON(operator>=, _CMP_GE_OQ)
GAUSSLITE_COMPARISON(operator==, _CMP_EQ_OQ)
#undef GAUSSLITE_COMPARISON

GAUSSLITE_INLINE Pack16 zero_unless(Mask16 m, Pack16 a) {
  return {_mm256_and_ps(m.lo, a.lo), _mm256_and_ps(m.hi, a.hi)};
}
GAUSSLITE_INLINE Pack16 zero_unless(bool condition, Pack16 a) {
  const __m256 mask = _mm256_castsi256_ps(_mm256_set1_epi32(-int(condition)));
  return {_mm256_and_ps(mask, a.lo), _mm256_and_ps(mask, a.hi)};
}
GAUSSLITE_INLINE Pack16 select(Mask16 m, Pack16 yes, Pack16 no) {
  return {_mm256_blendv_ps(no.lo, yes.lo, m.lo), _mm256_blendv_ps(no.hi, yes.hi, m.hi)};
}

GAUSSLITE_INLINE Pack16 fraction(Pack16 e) { return e - floor(e); }

// Adds floor(e), limited to -126 ... 127, to the exponent field of a.
GAUSSLITE_INLINE Pack16 multiply_by_power_of_two(Pack16 a, Pack16 e) {
  const Pack16 power = floor(min(max(e, Pack16(-126.0f)), Pack16(127.0f)));
  const __m256i lo = _mm256_slli_epi32(_mm256_cvtps_epi32(power.lo), 23);
  const __m256i hi = _mm256_slli_epi32(_mm256_cvtps_epi32(power.hi), 23);
  return {_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.lo), lo)),
          _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.hi), hi))};
}

// Element j: the bits of the float 2^(j / 8), minus j << 20. With j = k mod 8, adding k << 20 gives the bits of
// 2^(k / 8): the exponent field starts at bit 23, so that it increases by 1 with each 8 of k.
alignas(32) constexpr uint32_t kExp2Table[8] = {0x3F800000, 0x3F7B95C2, 0x3F7837F0, 0x3F75FED7,
                                                0x3F7504F3, 0x3F75672A, 0x3F7744FD, 0x3F7AC0C7};
// exp2_fast (pack.h) splits 2^e into 2^(k / n) 2^f, n = kExp2TableSize. exp2_of_steps returns 2^(k / n).
constexpr int kExp2TableSize = 8;
GAUSSLITE_INLINE __m256 exp2_of_steps(__m256 biased_steps) {
  const __m256i steps = _mm256_castps_si256(biased_steps);
  const __m256i powers = _mm256_load_si256(reinterpret_cast<const __m256i*>(kExp2Table));
  const __m256i power = _mm256_permutevar8x32_epi32(powers, steps);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_slli_epi32(steps, 20), power));
}
GAUSSLITE_INLINE Pack16 exp2_of_steps(Pack16 biased_steps) {
  return {exp2_of_steps(biased_steps.lo), exp2_of_steps(biased_steps.hi)};
}

GAUSSLITE_INLINE __m256 exponent(__m256 a) {
  const __m256i biased = _mm256_srli_epi32(_mm256_castps_si256(a), 23);
  return _mm256_cvtepi32_ps(_mm256_sub_epi32(biased, _mm256_set1_epi32(127)));
}
GAUSSLITE_INLINE __m256 mantissa(__m256 a) {
  const __m256i mantissa_bits = _mm256_and_si256(_mm256_castps_si256(a), _mm256_set1_epi32(0x007FFFFF));
  return _mm256_castsi256_ps(_mm256_or_si256(mantissa_bits, _mm256_set1_epi32(0x3F800000)));
}
GAUSSLITE_INLINE Pack16 exponent(Pack16 a) { return {exponent(a.lo), exponent(a.hi)}; }
GAUSSLITE_INLINE Pack16 mantissa(Pack16 a) { return {mantissa(a.lo), mantissa(a.hi)}; }

GAUSSLITE_INLINE Pack8 sum_of_quads(Pack16 a) {
  const __m256 half = _mm256_add_ps(a.lo, a.hi);
  return _mm256_zextps128_ps256(_mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
}
GAUSSLITE_INLINE float sum(Pack16 a) {
  const __m128 quad = _mm256_castps256_ps128(sum_of_quads(a).v);
  const __m128 pair = _mm_add_ps(quad, _mm_movehl_ps(quad, quad));
  return _mm_cvtss_f32(_mm_add_ss(pair, _mm_movehdup_ps(pair)));
}

template <int kLane>
GAUSSLITE_INLINE Pack16 broadcast_within_quads(Pack16 a) {
  return {_mm256_permute_ps(a.lo, kLane * 0x55), _mm256_permute_ps(a.hi, kLane * 0x55)};
}

GAUSSLITE_INLINE void transpose_within_quads(__m256& a, __m256& b, __m256& c, __m256& d) {
  const __m256 ac_lo = _mm256_unpacklo_ps(a, c), ac_hi = _mm256_unpackhi_ps(a, c);
  const __m256 bd_lo = _mm256_unpacklo_ps(b, d), bd_hi = _mm256_unpackhi_ps(b, d);
  a = _mm256_unpacklo_ps(ac_lo, bd_lo);
  b = _mm256_unpackhi_ps(ac_lo, bd_lo);
  c = _mm256_unpacklo_ps(ac_hi, bd_hi);
  d = _mm256_unpackhi_ps(ac_hi, bd_hi);
}
GAUSSLITE_INLINE void transpose_within_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  transpose_within_quads(a.lo, b.lo, c.lo, d.lo);
  transpose_within_quads(a.hi, b.hi, c.hi, d.hi);
}

GAUSSLITE_INLINE void transpose_whole_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  const Pack16 p = a, q = b, r = c, s = d;
  a = {_mm256_permute2f128_ps(p.lo, q.lo, 0x20), _mm256_permute2f128_ps(r.lo, s.lo, 0x20)};
  b = {_mm256_permute2f128_ps(p.lo, q.lo, 0x31), _mm256_permute2f128_ps(r.lo, s.lo, 0x31)};
  c = {_mm256_permute2f128_ps(p.hi, q.hi, 0x20), _mm256_permute2f128_ps(r.hi, s.hi, 0x20)};
  d = {_mm256_permute2f128_ps(p.hi, q.hi, 0x31), _mm256_permute2f128_ps(r.hi, s.hi, 0x31)};
}

GAUSSLITE_INLINE void pair_quads(Pack16 a, Pack16 b, Pack8 (&out)[4]) {
  out[0] = _mm256_permute2f128_ps(a.lo, b.lo, 0x20);
  out[1] = _mm256_permute2f128_ps(a.lo, b.lo, 0x31);
  out[2] = _mm256_permute2f128_ps(a.hi, b.hi, 0x20);
  out[3] = _mm256_permute2f128_ps(a.hi, b.hi, 0x31);
}

GAUSSLITE_INLINE Pack16 load_block(const float* p, int64_t stride) {
  return {_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p)), _mm_loadu_ps(p + stride), 1),
          _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p + 2 * stride)), _mm_loadu_ps(p + 3 * stride), 1)};
}
GAUSSLITE_INLINE Pack16 pack_of_bytes(__m128i bytes) {
  return {_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(bytes)),
          _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_srli_si128(bytes, 8)))};
}
GAUSSLITE_INLINE Pack16 load_bytes(const uint8_t* p) {
  return pack_of_bytes(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p)));
}
GAUSSLITE_INLINE Pack16 load_byte_block(const uint8_t* p, int64_t stride) {
  return pack_of_bytes(byte_block(p, stride));
}
GAUSSLITE_INLINE void store_block(float* p, int64_t stride, Pack16 a) {
  _mm_storeu_ps(p, _mm256_castps256_ps128(a.lo));
  _mm_storeu_ps(p + stride, _mm256_extractf128_ps(a.lo, 1));
  _mm_storeu_ps(p + 2 * stride, _mm256_castps256_ps128(a.hi));
  _mm_storeu_ps(p + 3 * stride, _mm256_extractf128_ps(a.hi, 1));
}

GAUSSLITE_INLINE Pack8 lower(Pack16 a) { return a.lo; }
GAUSSLITE_INLINE Pack8 upper(Pack16 a) { return a.hi; }
GAUSSLITE_INLINE Pack16 join(Pack8 lo, Pack8 hi) { return {lo.v, hi.v}; }

}  // namespace gausslite::GAUSSLITE_ISA
