// SPDX-License-Identifier: Apache-2.0
// Sixteen floats in four NEON registers (AArch64). pack_portable.h documents the functions.
#pragma once

#include <arm_neon.h>

#include <cstdint>
#include <cstring>

namespace gausslite::GAUSSLITE_ISA {

constexpr bool kFitsOneRegister = false;

struct Mask16 {
  uint32x4_t q[4];
};

struct Pack16 {
  float32x4_t q[4];
  Pack16() = default;
  GAUSSLITE_INLINE Pack16(float32x4_t a, float32x4_t b, float32x4_t c, float32x4_t d) : q{a, b, c, d} {}
  GAUSSLITE_INLINE Pack16(float x) : Pack16(vdupq_n_f32(x), vdupq_n_f32(x), vdupq_n_f32(x), vdupq_n_f32(x)) {}
};

#define GAUSSLITE_UNARY(name, op) \
  GAUSSLITE_INLINE Pack16 name(Pack16 a) { return {op(a.q[0]), op(a.q[1]), op(a.q[2]), op(a.q[3])}; }
#define GAUSSLITE_LANEWISE(name, op)                                                         \
  GAUSSLITE_INLINE Pack16 name(Pack16 a, Pack16 b) {                                         \
    return {op(a.q[0], b.q[0]), op(a.q[1], b.q[1]), op(a.q[2], b.q[2]), op(a.q[3], b.q[3])}; \
  }
#define GAUSSLITE_MASKWISE(name, op)                                                           \
  GAUSSLITE_INLINE Mask16 name(Mask16 a, Mask16 b) {                                           \
    return {{op(a.q[0], b.q[0]), op(a.q[1], b.q[1]), op(a.q[2], b.q[2]), op(a.q[3], b.q[3])}}; \
  }
#define GAUSSLITE_COMPARISON(name, op)                                                         \
  GAUSSLITE_INLINE Mask16 name(Pack16 a, Pack16 b) {                                           \
    return {{op(a.q[0], b.q[0]), op(a.q[1], b.q[1]), op(a.q[2], b.q[2]), op(a.q[3], b.q[3])}}; \
  }

GAUSSLITE_MASKWISE(operator&, vandq_u32)
GAUSSLITE_MASKWISE(operator|, vorrq_u32)

// NEON has no movemask: narrow the lanes to bytes, mask each byte to the bit of its lane, and add the bytes of each
// half.
GAUSSLITE_INLINE uint32_t bits(Mask16 m) {
  const uint16x8_t lo = vuzp1q_u16(vreinterpretq_u16_u32(m.q[0]), vreinterpretq_u16_u32(m.q[1]));
  const uint16x8_t hi = vuzp1q_u16(vreinterpretq_u16_u32(m.q[2]), vreinterpretq_u16_u32(m.q[3]));
  const uint8x16_t lanes = vuzp1q_u8(vreinterpretq_u8_u16(lo), vreinterpretq_u8_u16(hi));
  const uint8x16_t lane_bits = vandq_u8(lanes, vreinterpretq_u8_u64(vdupq_n_u64(0x8040201008040201u)));
  return uint32_t(vaddv_u8(vget_low_u8(lane_bits))) | uint32_t(vaddv_u8(vget_high_u8(lane_bits))) << 8;
}
GAUSSLITE_INLINE bool any(Mask16 m) {
  return vmaxvq_u32(vorrq_u32(vorrq_u32(m.q[0], m.q[1]), vorrq_u32(m.q[2], m.q[3]))) != 0;
}
// Lane k is true if `bits` has the bit `first_bit` << k.
GAUSSLITE_INLINE uint32x4_t mask_quad(uint32_t bits, uint32_t first_bit) {
  const uint32x4_t lane_bits = {first_bit, first_bit << 1, first_bit << 2, first_bit << 3};
  return vtstq_u32(vdupq_n_u32(bits), lane_bits);
}
GAUSSLITE_INLINE Mask16 mask_of(uint32_t bits) {
  return {{mask_quad(bits, 1u), mask_quad(bits, 1u << 4), mask_quad(bits, 1u << 8), mask_quad(bits, 1u << 12)}};
}

GAUSSLITE_INLINE Pack16 load(const float* p) {
  return {vld1q_f32(p), vld1q_f32(p + 4), vld1q_f32(p + 8), vld1q_f32(p + 12)};
}
GAUSSLITE_INLINE void store(float* p, Pack16 a) {
  for (int i = 0; i < 4; ++i) vst1q_f32(p + 4 * i, a.q[i]);
}
GAUSSLITE_INLINE void store_int(int32_t* p, Pack16 a) {
  for (int i = 0; i < 4; ++i) vst1q_s32(p + 4 * i, vcvtq_s32_f32(a.q[i]));
}

// vminq and vmaxq would return NaN if a is NaN. All variants return b, so that a clamp of NaN returns its bound.
GAUSSLITE_INLINE float32x4_t min_quad(float32x4_t a, float32x4_t b) { return vbslq_f32(vcltq_f32(a, b), a, b); }
GAUSSLITE_INLINE float32x4_t max_quad(float32x4_t a, float32x4_t b) { return vbslq_f32(vcgtq_f32(a, b), a, b); }

GAUSSLITE_LANEWISE(operator+, vaddq_f32)
GAUSSLITE_LANEWISE(operator-, vsubq_f32)
GAUSSLITE_LANEWISE(operator*, vmulq_f32)
GAUSSLITE_LANEWISE(operator/, vdivq_f32)
GAUSSLITE_LANEWISE(min, min_quad)
GAUSSLITE_LANEWISE(max, max_quad)
GAUSSLITE_UNARY(operator-, vnegq_f32)
GAUSSLITE_UNARY(abs, vabsq_f32)
GAUSSLITE_UNARY(sqrt, vsqrtq_f32)
GAUSSLITE_UNARY(floor, vrndmq_f32)
GAUSSLITE_UNARY(ceil, vrndpq_f32)

GAUSSLITE_INLINE Pack16 fma(Pack16 a, Pack16 b, Pack16 c) {
  return {vfmaq_f32(c.q[0], a.q[0], b.q[0]), vfmaq_f32(c.q[1], a.q[1], b.q[1]), vfmaq_f32(c.q[2], a.q[2], b.q[2]),
          vfmaq_f32(c.q[3], a.q[3], b.q[3])};
}
GAUSSLITE_INLINE Pack16 fnma(Pack16 a, Pack16 b, Pack16 c) {
  return {vfmsq_f32(c.q[0], a.q[0], b.q[0]), vfmsq_f32(c.q[1], a.q[1], b.q[1]), vfmsq_f32(c.q[2], a.q[2], b.q[2]),
          vfmsq_f32(c.q[3], a.q[3], b.q[3])};
}

// The hardware estimates have a precision of 8 bits. One Newton step gives at least 15 bits, two steps nearly all 24.
GAUSSLITE_INLINE float32x4_t rough_reciprocal_quad(float32x4_t a) {
  const float32x4_t r = vrecpeq_f32(a);
  return vmulq_f32(r, vrecpsq_f32(a, r));
}
GAUSSLITE_INLINE float32x4_t reciprocal_quad(float32x4_t a) {
  const float32x4_t r = rough_reciprocal_quad(a);
  return vmulq_f32(r, vrecpsq_f32(a, r));
}
GAUSSLITE_INLINE float32x4_t rough_inverse_sqrt_quad(float32x4_t a) {
  const float32x4_t r = vrsqrteq_f32(a);
  return vmulq_f32(r, vrsqrtsq_f32(vmulq_f32(a, r), r));
}
GAUSSLITE_UNARY(reciprocal, reciprocal_quad)
GAUSSLITE_UNARY(rough_reciprocal, rough_reciprocal_quad)
GAUSSLITE_UNARY(rough_inverse_sqrt, rough_inverse_sqrt_quad)

GAUSSLITE_COMPARISON(operator<, vcltq_f32)
GAUSSLITE_COMPARISON(operator<=, vcleq_f32)
GAUSSLITE_COMPARISON(operator>, vcgtq_f32)
GAUSSLITE_COMPARISON(operator>=, vcgeq_f32)
GAUSSLITE_COMPARISON(operator==, vceqq_f32)

GAUSSLITE_INLINE Pack16 select(Mask16 m, Pack16 yes, Pack16 no) {
  return {vbslq_f32(m.q[0], yes.q[0], no.q[0]), vbslq_f32(m.q[1], yes.q[1], no.q[1]),
          vbslq_f32(m.q[2], yes.q[2], no.q[2]), vbslq_f32(m.q[3], yes.q[3], no.q[3])};
}
GAUSSLITE_INLINE Pack16 zero_unless(Mask16 m, Pack16 a) { return select(m, a, Pack16(0.0f)); }
GAUSSLITE_INLINE Pack16 zero_unless(bool condition, Pack16 a) {
  const uint32x4_t mask = vdupq_n_u32(uint32_t(-int(condition)));
  return select({mask, mask, mask, mask}, a, Pack16(0.0f));
}

// Adds floor(e), limited to -126 ... 127, to the exponent field of a.
GAUSSLITE_INLINE float32x4_t multiply_by_power_of_two_quad(float32x4_t a, float32x4_t e) {
  const float32x4_t limited = min_quad(max_quad(e, vdupq_n_f32(-126.0f)), vdupq_n_f32(127.0f));
  const int32x4_t exponent_bits = vshlq_n_s32(vcvtmq_s32_f32(limited), 23);
  return vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(a), exponent_bits));
}
GAUSSLITE_INLINE float32x4_t exponent_quad(float32x4_t a) {
  return vcvtq_f32_s32(vsubq_s32(vshrq_n_s32(vreinterpretq_s32_f32(a), 23), vdupq_n_s32(127)));
}
GAUSSLITE_INLINE float32x4_t mantissa_quad(float32x4_t a) {
  const uint32x4_t mantissa_bits = vandq_u32(vreinterpretq_u32_f32(a), vdupq_n_u32(0x007FFFFF));
  return vreinterpretq_f32_u32(vorrq_u32(mantissa_bits, vdupq_n_u32(0x3F800000)));
}
GAUSSLITE_INLINE Pack16 fraction(Pack16 e) { return e - floor(e); }
GAUSSLITE_LANEWISE(multiply_by_power_of_two, multiply_by_power_of_two_quad)
// exp2_fast (pack.h) splits 2^e into 2^(k / n) 2^f. This returns 2^(k / n), for n = 1 without a table.
constexpr int kExp2TableSize = 1;
GAUSSLITE_INLINE float32x4_t exp2_of_steps_quad(float32x4_t biased_steps) {
  const int32x4_t exponents = vshlq_n_s32(vreinterpretq_s32_f32(biased_steps), 23);
  return vreinterpretq_f32_s32(vaddq_s32(exponents, vdupq_n_s32(0x3F800000)));
}
GAUSSLITE_UNARY(exp2_of_steps, exp2_of_steps_quad)
GAUSSLITE_UNARY(exponent, exponent_quad)
GAUSSLITE_UNARY(mantissa, mantissa_quad)

#undef GAUSSLITE_UNARY
#undef GAUSSLITE_LANEWISE
#undef GAUSSLITE_MASKWISE
#undef GAUSSLITE_COMPARISON

template <int kLane>
GAUSSLITE_INLINE Pack16 broadcast_within_quads(Pack16 a) {
  return {vdupq_laneq_f32(a.q[0], kLane), vdupq_laneq_f32(a.q[1], kLane), vdupq_laneq_f32(a.q[2], kLane),
          vdupq_laneq_f32(a.q[3], kLane)};
}

GAUSSLITE_INLINE void transpose_quad(float32x4_t& a, float32x4_t& b, float32x4_t& c, float32x4_t& d) {
  const float32x4_t ac_lo = vzip1q_f32(a, c), ac_hi = vzip2q_f32(a, c);
  const float32x4_t bd_lo = vzip1q_f32(b, d), bd_hi = vzip2q_f32(b, d);
  a = vzip1q_f32(ac_lo, bd_lo);
  b = vzip2q_f32(ac_lo, bd_lo);
  c = vzip1q_f32(ac_hi, bd_hi);
  d = vzip2q_f32(ac_hi, bd_hi);
}
// Four 4x4 matrices of floats: matrix i has the rows a.q[i], b.q[i], c.q[i], d.q[i].
GAUSSLITE_INLINE void transpose_within_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  for (int i = 0; i < 4; ++i) transpose_quad(a.q[i], b.q[i], c.q[i], d.q[i]);
}

// One 4x4 matrix of quads, with the rows a, b, c, d; the lanes of a quad keep their order.
GAUSSLITE_INLINE void transpose_whole_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  const Pack16 p = a, q = b, r = c, s = d;
  a = {p.q[0], q.q[0], r.q[0], s.q[0]};
  b = {p.q[1], q.q[1], r.q[1], s.q[1]};
  c = {p.q[2], q.q[2], r.q[2], s.q[2]};
  d = {p.q[3], q.q[3], r.q[3], s.q[3]};
}

GAUSSLITE_INLINE Pack16 load_block(const float* p, int64_t stride) {
  return {vld1q_f32(p), vld1q_f32(p + stride), vld1q_f32(p + 2 * stride), vld1q_f32(p + 3 * stride)};
}
GAUSSLITE_INLINE Pack16 pack_of_bytes(uint8x16_t bytes) {
  const uint16x8_t lo = vmovl_u8(vget_low_u8(bytes)), hi = vmovl_high_u8(bytes);
  return {vcvtq_f32_u32(vmovl_u16(vget_low_u16(lo))), vcvtq_f32_u32(vmovl_high_u16(lo)),
          vcvtq_f32_u32(vmovl_u16(vget_low_u16(hi))), vcvtq_f32_u32(vmovl_high_u16(hi))};
}
GAUSSLITE_INLINE Pack16 load_bytes(const uint8_t* p) { return pack_of_bytes(vld1q_u8(p)); }
GAUSSLITE_INLINE Pack16 load_byte_block(const uint8_t* p, int64_t stride) {
  uint32_t rows[4];
  for (int i = 0; i < 4; ++i) std::memcpy(&rows[i], p + i * stride, sizeof rows[i]);
  return pack_of_bytes(vreinterpretq_u8_u32(vld1q_u32(rows)));
}
GAUSSLITE_INLINE void store_block(float* p, int64_t stride, Pack16 a) {
  for (int i = 0; i < 4; ++i) vst1q_f32(p + i * stride, a.q[i]);
}

struct Pack8 {
  float32x4_t lo, hi;
  Pack8() = default;
  GAUSSLITE_INLINE Pack8(float32x4_t a, float32x4_t b) : lo(a), hi(b) {}
  GAUSSLITE_INLINE Pack8(float x) : lo(vdupq_n_f32(x)), hi(lo) {}
};

GAUSSLITE_INLINE Pack8 load8(const float* p) { return {vld1q_f32(p), vld1q_f32(p + 4)}; }
GAUSSLITE_INLINE void store8(float* p, Pack8 a) {
  vst1q_f32(p, a.lo);
  vst1q_f32(p + 4, a.hi);
}
GAUSSLITE_INLINE Pack8 broadcast_pair(const float* p) {
  const float32x2_t pair = vld1_f32(p);
  return {vcombine_f32(pair, pair), vcombine_f32(pair, pair)};
}
GAUSSLITE_INLINE Pack8 operator+(Pack8 a, Pack8 b) { return {vaddq_f32(a.lo, b.lo), vaddq_f32(a.hi, b.hi)}; }
GAUSSLITE_INLINE Pack8 operator-(Pack8 a, Pack8 b) { return {vsubq_f32(a.lo, b.lo), vsubq_f32(a.hi, b.hi)}; }
GAUSSLITE_INLINE Pack8 operator*(Pack8 a, Pack8 b) { return {vmulq_f32(a.lo, b.lo), vmulq_f32(a.hi, b.hi)}; }
GAUSSLITE_INLINE Pack8 fma(Pack8 a, Pack8 b, Pack8 c) {
  return {vfmaq_f32(c.lo, a.lo, b.lo), vfmaq_f32(c.hi, a.hi, b.hi)};
}
GAUSSLITE_INLINE Pack8 fnma(Pack8 a, Pack8 b, Pack8 c) {
  return {vfmsq_f32(c.lo, a.lo, b.lo), vfmsq_f32(c.hi, a.hi, b.hi)};
}

// Each half compiles to one table look-up (TBL) in the 32 bytes of x.
template <int a, int b, int c, int d, int e, int f, int g, int h>
GAUSSLITE_INLINE Pack8 permute(Pack8 x) {
  return {__builtin_shufflevector(x.lo, x.hi, a, b, c, d), __builtin_shufflevector(x.lo, x.hi, e, f, g, h)};
}

// Lanes 0-3: the sum of the four quads, lane by lane; lanes 4-7: 0.
GAUSSLITE_INLINE Pack8 sum_of_quads(Pack16 a) {
  return {vaddq_f32(vaddq_f32(a.q[0], a.q[2]), vaddq_f32(a.q[1], a.q[3])), vdupq_n_f32(0.0f)};
}
GAUSSLITE_INLINE float sum(Pack16 a) { return vaddvq_f32(sum_of_quads(a).lo); }

GAUSSLITE_INLINE void pair_quads(Pack16 a, Pack16 b, Pack8 (&out)[4]) {
  for (int k = 0; k < 4; ++k) out[k] = {a.q[k], b.q[k]};
}

GAUSSLITE_INLINE Pack8 lower(Pack16 a) { return {a.q[0], a.q[1]}; }
GAUSSLITE_INLINE Pack8 upper(Pack16 a) { return {a.q[2], a.q[3]}; }
GAUSSLITE_INLINE Pack16 join(Pack8 lo, Pack8 hi) { return {lo.lo, lo.hi, hi.lo, hi.hi}; }

}  // namespace gausslite::GAUSSLITE_ISA
