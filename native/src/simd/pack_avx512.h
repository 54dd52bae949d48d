// SPDX-License-Identifier: Apache-2.0
// Sixteen floats in one AVX-512 register. All variants have the same functions; pack_portable.h documents them.
#pragma once

#include <immintrin.h>

#include <cstdint>

#include "simd/pack8_avx.h"

namespace gausslite::GAUSSLITE_ISA {

constexpr bool kFitsOneRegister = true;

struct Mask16 {
  __mmask16 v;
};

GAUSSLITE_INLINE Mask16 operator&(Mask16 a, Mask16 b) { return {__mmask16(a.v & b.v)}; }
GAUSSLITE_INLINE Mask16 operator|(Mask16 a, Mask16 b) { return {__mmask16(a.v | b.v)}; }
GAUSSLITE_INLINE uint32_t bits(Mask16 m) { return m.v; }
GAUSSLITE_INLINE bool any(Mask16 m) { return m.v != 0; }
GAUSSLITE_INLINE Mask16 mask_of(uint32_t bits) { return {__mmask16(bits)}; }

struct Pack16 {
  __m512 v;
  Pack16() = default;
  GAUSSLITE_INLINE Pack16(__m512 x) : v(x) {}
  GAUSSLITE_INLINE Pack16(float x) : v(_mm512_set1_ps(x)) {}
};

GAUSSLITE_INLINE Pack16 load(const float* p) { return _mm512_loadu_ps(p); }
GAUSSLITE_INLINE void store(float* p, Pack16 a) { _mm512_storeu_ps(p, a.v); }
GAUSSLITE_INLINE void store_int(int32_t* p, Pack16 a) { _mm512_storeu_si512(p, _mm512_cvttps_epi32(a.v)); }

GAUSSLITE_INLINE Pack16 operator+(Pack16 a, Pack16 b) { return _mm512_add_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 operator-(Pack16 a, Pack16 b) { return _mm512_sub_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 operator*(Pack16 a, Pack16 b) { return _mm512_mul_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 operator/(Pack16 a, Pack16 b) { return _mm512_div_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 operator-(Pack16 a) { return _mm512_xor_ps(a.v, _mm512_set1_ps(-0.0f)); }
GAUSSLITE_INLINE Pack16 fma(Pack16 a, Pack16 b, Pack16 c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
GAUSSLITE_INLINE Pack16 fnma(Pack16 a, Pack16 b, Pack16 c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
GAUSSLITE_INLINE Pack16 min(Pack16 a, Pack16 b) { return _mm512_min_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 max(Pack16 a, Pack16 b) { return _mm512_max_ps(a.v, b.v); }
GAUSSLITE_INLINE Pack16 abs(Pack16 a) { return _mm512_abs_ps(a.v); }
GAUSSLITE_INLINE Pack16 sqrt(Pack16 a) { return _mm512_sqrt_ps(a.v); }
GAUSSLITE_INLINE Pack16 floor(Pack16 a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
GAUSSLITE_INLINE Pack16 ceil(Pack16 a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); }
GAUSSLITE_INLINE Pack16 rough_reciprocal(Pack16 a) { return _mm512_rcp14_ps(a.v); }
GAUSSLITE_INLINE Pack16 rough_inverse_sqrt(Pack16 a) { return _mm512_rsqrt14_ps(a.v); }
GAUSSLITE_INLINE Pack16 reciprocal(Pack16 a) {
  const Pack16 r = rough_reciprocal(a);
  return r * fnma(a, r, Pack16(2.0f));
}

GAUSSLITE_INLINE Mask16 operator<(Pack16 a, Pack16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
GAUSSLITE_INLINE Mask16 operator<=(Pack16 a, Pack16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
GAUSSLITE_INLINE Mask16 operator>(Pack16 a, Pack16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
GAUSSLITE_INLINE Mask16 operator>=(Pack16 a, Pack16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
GAUSSLITE_INLINE Mask16 operator==(Pack16 a, Pack16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_EQ_OQ)}; }

GAUSSLITE_INLINE Pack16 zero_unless(Mask16 m, Pack16 a) { return _mm512_maskz_mov_ps(m.v, a.v); }
GAUSSLITE_INLINE Pack16 zero_unless(bool condition, Pack16 a) {
  return _mm512_maskz_mov_ps(__mmask16(-int(condition)), a.v);
}
GAUSSLITE_INLINE Pack16 select(Mask16 m, Pack16 yes, Pack16 no) { return _mm512_mask_mov_ps(no.v, m.v, yes.v); }
GAUSSLITE_INLINE float sum(Pack16 a) { return _mm512_reduce_add_ps(a.v); }

// vreduceps returns e - floor(e), vscalefps multiplies by 2^floor(e): no integer conversion and no clamping.
GAUSSLITE_INLINE Pack16 fraction(Pack16 e) { return _mm512_reduce_ps(e.v, 0x01); }
GAUSSLITE_INLINE Pack16 multiply_by_power_of_two(Pack16 a, Pack16 e) { return _mm512_scalef_ps(a.v, e.v); }
GAUSSLITE_INLINE Pack16 exponent(Pack16 a) { return _mm512_getexp_ps(a.v); }
GAUSSLITE_INLINE Pack16 mantissa(Pack16 a) { return _mm512_getmant_ps(a.v, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_zero); }

// Element j: the bits of the float 2^(j / 16), minus j << 19. With j = k mod 16, adding k << 19 gives the bits of
// 2^(k / 16): the exponent field starts at bit 23, so that it increases by 1 with each 16 of k.
alignas(64) constexpr uint32_t kExp2Table[16] = {0x3F800000, 0x3F7DAAC3, 0x3F7B95C2, 0x3F79C3D3, 0x3F7837F0, 0x3F76F532,
                                                 0x3F75FED7, 0x3F75583F, 0x3F7504F3, 0x3F7508A4, 0x3F75672A, 0x3F76248C,
                                                 0x3F7744FD, 0x3F78CCDF, 0x3F7AC0C7, 0x3F7D257D};
// exp2_fast (pack.h) splits 2^e into 2^(k / n) 2^f, n = kExp2TableSize. exp2_of_steps returns 2^(k / n).
constexpr int kExp2TableSize = 16;
GAUSSLITE_INLINE Pack16 exp2_of_steps(Pack16 biased_steps) {
  const __m512i steps = _mm512_castps_si512(biased_steps.v);
  const __m512i power = _mm512_permutexvar_epi32(steps, _mm512_load_si512(kExp2Table));
  return _mm512_castsi512_ps(_mm512_add_epi32(_mm512_slli_epi32(steps, 19), power));
}

template <int kLane>
GAUSSLITE_INLINE Pack16 broadcast_within_quads(Pack16 a) {
  return _mm512_permute_ps(a.v, kLane * 0x55);
}

GAUSSLITE_INLINE void transpose_within_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  const __m512 ac_lo = _mm512_unpacklo_ps(a.v, c.v), ac_hi = _mm512_unpackhi_ps(a.v, c.v);
  const __m512 bd_lo = _mm512_unpacklo_ps(b.v, d.v), bd_hi = _mm512_unpackhi_ps(b.v, d.v);
  a = _mm512_unpacklo_ps(ac_lo, bd_lo);
  b = _mm512_unpackhi_ps(ac_lo, bd_lo);
  c = _mm512_unpacklo_ps(ac_hi, bd_hi);
  d = _mm512_unpackhi_ps(ac_hi, bd_hi);
}

GAUSSLITE_INLINE void transpose_whole_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  const __m512 ab_even = _mm512_shuffle_f32x4(a.v, b.v, 0x88), ab_odd = _mm512_shuffle_f32x4(a.v, b.v, 0xDD);
  const __m512 cd_even = _mm512_shuffle_f32x4(c.v, d.v, 0x88), cd_odd = _mm512_shuffle_f32x4(c.v, d.v, 0xDD);
  a = _mm512_shuffle_f32x4(ab_even, cd_even, 0x88);
  b = _mm512_shuffle_f32x4(ab_odd, cd_odd, 0x88);
  c = _mm512_shuffle_f32x4(ab_even, cd_even, 0xDD);
  d = _mm512_shuffle_f32x4(ab_odd, cd_odd, 0xDD);
}

GAUSSLITE_INLINE void pair_quads(Pack16 a, Pack16 b, Pack8 (&out)[4]) {
  const __m512d x = _mm512_castps_pd(a.v), y = _mm512_castps_pd(b.v);
  const __m512 low = _mm512_castpd_ps(_mm512_permutex2var_pd(x, _mm512_setr_epi64(0, 1, 8, 9, 2, 3, 10, 11), y));
  const __m512 high = _mm512_castpd_ps(_mm512_permutex2var_pd(x, _mm512_setr_epi64(4, 5, 12, 13, 6, 7, 14, 15), y));
  out[0] = _mm512_castps512_ps256(low);
  out[1] = _mm512_extractf32x8_ps(low, 1);
  out[2] = _mm512_castps512_ps256(high);
  out[3] = _mm512_extractf32x8_ps(high, 1);
}

GAUSSLITE_INLINE Pack16 load_block(const float* p, int64_t stride) {
  __m512 v = _mm512_castps128_ps512(_mm_loadu_ps(p));
  v = _mm512_insertf32x4(v, _mm_loadu_ps(p + stride), 1);
  v = _mm512_insertf32x4(v, _mm_loadu_ps(p + 2 * stride), 2);
  return _mm512_insertf32x4(v, _mm_loadu_ps(p + 3 * stride), 3);
}

GAUSSLITE_INLINE Pack16 pack_of_bytes(__m128i bytes) { return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(bytes)); }
GAUSSLITE_INLINE Pack16 load_bytes(const uint8_t* p) {
  return pack_of_bytes(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p)));
}
GAUSSLITE_INLINE Pack16 load_byte_block(const uint8_t* p, int64_t stride) {
  return pack_of_bytes(byte_block(p, stride));
}

GAUSSLITE_INLINE void store_block(float* p, int64_t stride, Pack16 a) {
  _mm_storeu_ps(p, _mm512_castps512_ps128(a.v));
  _mm_storeu_ps(p + stride, _mm512_extractf32x4_ps(a.v, 1));
  _mm_storeu_ps(p + 2 * stride, _mm512_extractf32x4_ps(a.v, 2));
  _mm_storeu_ps(p + 3 * stride, _mm512_extractf32x4_ps(a.v, 3));
}

GAUSSLITE_INLINE Pack8 sum_of_quads(Pack16 a) {
  const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1));
  return _mm256_zextps128_ps256(_mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
}

GAUSSLITE_INLINE Pack8 lower(Pack16 a) { return _mm512_castps512_ps256(a.v); }
GAUSSLITE_INLINE Pack8 upper(Pack16 a) { return _mm512_extractf32x8_ps(a.v, 1); }
GAUSSLITE_INLINE Pack16 join(Pack8 lo, Pack8 hi) { return _mm512_insertf32x8(_mm512_castps256_ps512(lo.v), hi.v, 1); }

}  // namespace gausslite::GAUSSLITE_ISA
