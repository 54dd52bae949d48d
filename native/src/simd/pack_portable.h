// SPDX-License-Identifier: Apache-2.0
// Sixteen floats for any instruction set, in the compiler's vector types: they compile to SSE, NEON or scalar code.
// This variant is the fallback, the reference of the other variants, and the documentation of each function.
//
// A pack has sixteen lanes. Lanes 4 k ... 4 k + 3 are its quad k, for k = 0 ... 3. Loads and stores need no alignment.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace gausslite::GAUSSLITE_ISA {

typedef float Quad __attribute__((vector_size(16)));
typedef int32_t QuadInt __attribute__((vector_size(16)));

GAUSSLITE_INLINE Quad quad(float x) { return Quad{x, x, x, x}; }
GAUSSLITE_INLINE Quad load_quad(const float* p) {
  Quad q;
  std::memcpy(&q, p, sizeof q);
  return q;
}
GAUSSLITE_INLINE void store_quad(float* p, Quad q) { std::memcpy(p, &q, sizeof q); }
GAUSSLITE_INLINE Quad select_quad(QuadInt mask, Quad yes, Quad no) {
  return (Quad)((mask & (QuadInt)yes) | (~mask & (QuadInt)no));
}
GAUSSLITE_INLINE Quad floor_quad(Quad a) {
  // Floats beyond 2^23 are integers, and their conversion to int would overflow.
  const QuadInt small = (a < 8388608.0f) & (a > -8388608.0f);
  const QuadInt truncated = __builtin_convertvector(select_quad(small, a, quad(0.0f)), QuadInt);
  const Quad rounded = __builtin_convertvector(truncated, Quad);
  return select_quad(small, rounded - select_quad(rounded > a, quad(1.0f), quad(0.0f)), a);
}

// True if one register holds a pack, as with AVX-512. Loops then keep more packs in registers.
constexpr bool kFitsOneRegister = false;

// Sixteen truth values, one per lane.
struct Mask16 {
  QuadInt q[4];
};

// Runs the next statement for each quad i of a pack.
#define GAUSSLITE_FOR_EACH_QUAD for (int i = 0; i < 4; ++i)

GAUSSLITE_INLINE Mask16 operator&(Mask16 a, Mask16 b) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] &= b.q[i];
  return a;
}
GAUSSLITE_INLINE Mask16 operator|(Mask16 a, Mask16 b) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] |= b.q[i];
  return a;
}
// The mask as an integer, lane 0 in bit 0.
GAUSSLITE_INLINE uint32_t bits(Mask16 m) {
  uint32_t out = 0;
  for (int i = 0; i < 16; ++i) out |= uint32_t(m.q[i / 4][i % 4] & 1) << i;
  return out;
}
GAUSSLITE_INLINE bool any(Mask16 m) {
  const QuadInt quads = (m.q[0] | m.q[1]) | (m.q[2] | m.q[3]);
  return (quads[0] | quads[1] | quads[2] | quads[3]) != 0;
}
// Lane k is true where bit k is set.
GAUSSLITE_INLINE Mask16 mask_of(uint32_t bits) {
  Mask16 m;
  for (int i = 0; i < 16; ++i) m.q[i / 4][i % 4] = -int32_t(bits >> i & 1u);
  return m;
}

struct Pack16 {
  Quad q[4];
  Pack16() = default;
  GAUSSLITE_INLINE Pack16(float x) : q{quad(x), quad(x), quad(x), quad(x)} {}
};

GAUSSLITE_INLINE Pack16 load(const float* p) {
  Pack16 a;
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = load_quad(p + 4 * i);
  return a;
}
GAUSSLITE_INLINE void store(float* p, Pack16 a) { GAUSSLITE_FOR_EACH_QUAD store_quad(p + 4 * i, a.q[i]); }
// Truncates towards zero; the values must fit.
GAUSSLITE_INLINE void store_int(int32_t* p, Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD {
    const QuadInt integers = __builtin_convertvector(a.q[i], QuadInt);
    std::memcpy(p + 4 * i, &integers, sizeof integers);
  }
}

#define GAUSSLITE_LANEWISE(name, expression)         \
  GAUSSLITE_INLINE Pack16 name(Pack16 a, Pack16 b) { \
    Pack16 r;                                        \
    GAUSSLITE_FOR_EACH_QUAD r.q[i] = expression;     \
    return r;                                        \
  }
GAUSSLITE_LANEWISE(operator+, a.q[i] + b.q[i])
GAUSSLITE_LANEWISE(operator-, a.q[i] - b.q[i])
GAUSSLITE_LANEWISE(operator*, a.q[i] * b.q[i])
GAUSSLITE_LANEWISE(operator/, a.q[i] / b.q[i])
GAUSSLITE_LANEWISE(min, select_quad(a.q[i] < b.q[i], a.q[i], b.q[i]))
GAUSSLITE_LANEWISE(max, select_quad(a.q[i] > b.q[i], a.q[i], b.q[i]))
#undef GAUSSLITE_LANEWISE

GAUSSLITE_INLINE Pack16 operator-(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = -a.q[i];
  return a;
}
// a b + c and c - a b, with one rounding if the machine has fused operations.
GAUSSLITE_INLINE Pack16 fma(Pack16 a, Pack16 b, Pack16 c) { return a * b + c; }
GAUSSLITE_INLINE Pack16 fnma(Pack16 a, Pack16 b, Pack16 c) { return c - a * b; }
GAUSSLITE_INLINE Pack16 abs(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = (Quad)((QuadInt)a.q[i] & 0x7FFFFFFF);
  return a;
}
GAUSSLITE_INLINE Pack16 sqrt(Pack16 a) {
  for (int i = 0; i < 16; ++i) a.q[i / 4][i % 4] = __builtin_sqrtf(a.q[i / 4][i % 4]);
  return a;
}
GAUSSLITE_INLINE Pack16 floor(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = floor_quad(a.q[i]);
  return a;
}
GAUSSLITE_INLINE Pack16 ceil(Pack16 a) { return -floor(-a); }
// 1 / a to a relative error of about 2e-7 (reciprocal) and of 6.2e-5, 14 bits (rough_reciprocal). A variant without a
// faster rough function computes the more precise result: both functions are then the same.
GAUSSLITE_INLINE Pack16 reciprocal(Pack16 a) { return Pack16(1.0f) / a; }
GAUSSLITE_INLINE Pack16 rough_reciprocal(Pack16 a) { return Pack16(1.0f) / a; }
// 1 / sqrt(a) of positive a, to 14 bits.
GAUSSLITE_INLINE Pack16 rough_inverse_sqrt(Pack16 a) { return Pack16(1.0f) / sqrt(a); }

// Comparisons are false for NaN.
#define GAUSSLITE_COMPARISON(name, op)                 \
  GAUSSLITE_INLINE Mask16 name(Pack16 a, Pack16 b) {   \
    Mask16 m;                                          \
    GAUSSLITE_FOR_EACH_QUAD m.q[i] = a.q[i] op b.q[i]; \
    return m;                                          \
  }
GAUSSLITE_COMPARISON(operator<, <)
GAUSSLITE_COMPARISON(operator<=, <=)
GAUSSLITE_COMPARISON(operator>, >)
GAUSSLITE_COMPARISON(operator>=, >=)
GAUSSLITE_COMPARISON(operator==, ==)
#undef GAUSSLITE_COMPARISON

// a in the lanes where the mask is set, 0 in the others.
GAUSSLITE_INLINE Pack16 zero_unless(Mask16 m, Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = (Quad)(m.q[i] & (QuadInt)a.q[i]);
  return a;
}
// a if the condition is true, else 0 in all lanes.
GAUSSLITE_INLINE Pack16 zero_unless(bool condition, Pack16 a) {
  const int32_t mask = -int32_t(condition);
  return zero_unless({QuadInt{mask, mask, mask, mask}, QuadInt{mask, mask, mask, mask}, QuadInt{mask, mask, mask, mask},
                      QuadInt{mask, mask, mask, mask}},
                     a);
}
// `yes` in the lanes where the mask is set, `no` in the others.
GAUSSLITE_INLINE Pack16 select(Mask16 m, Pack16 yes, Pack16 no) {
  GAUSSLITE_FOR_EACH_QUAD yes.q[i] = select_quad(m.q[i], yes.q[i], no.q[i]);
  return yes;
}

// e - floor(e).
GAUSSLITE_INLINE Pack16 fraction(Pack16 e) { return e - floor(e); }
// a 2^floor(e), for normal a and a normal result. All variants except AVX-512 limit floor(e) to -126 ... 127 and add it
// to the exponent field of a.
GAUSSLITE_INLINE Pack16 multiply_by_power_of_two(Pack16 a, Pack16 e) {
  const Pack16 power = floor(min(max(e, Pack16(-126.0f)), Pack16(127.0f)));
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = (Quad)((QuadInt)a.q[i] + (__builtin_convertvector(power.q[i], QuadInt) << 23));
  return a;
}
// For positive normal a: a = mantissa(a) 2^exponent(a), with the mantissa in [1, 2).
GAUSSLITE_INLINE Pack16 exponent(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = __builtin_convertvector(((QuadInt)a.q[i] >> 23) - 127, Quad);
  return a;
}
GAUSSLITE_INLINE Pack16 mantissa(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = (Quad)(((QuadInt)a.q[i] & 0x007FFFFF) | 0x3F800000);
  return a;
}

// 2^(k / kExp2TableSize) for a number of steps k, in the lowest mantissa bits of the argument (see exp2_fast in
// pack.h). AVX2 and AVX-512 read 2^fraction(k / kExp2TableSize) from a table of 8 or 16 floats.
constexpr int kExp2TableSize = 1;
GAUSSLITE_INLINE Pack16 exp2_of_steps(Pack16 biased_steps) {
  Pack16 power;
  GAUSSLITE_FOR_EACH_QUAD power.q[i] = (Quad)(((QuadInt)biased_steps.q[i] << 23) + 0x3F800000);
  return power;
}

// The sum of all lanes.
GAUSSLITE_INLINE float sum(Pack16 a) {
  const Quad s = (a.q[0] + a.q[2]) + (a.q[1] + a.q[3]);
  return (s[0] + s[2]) + (s[1] + s[3]);
}

// In each quad, copies lane kLane to all four lanes.
template <int kLane>
GAUSSLITE_INLINE Pack16 broadcast_within_quads(Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = __builtin_shufflevector(a.q[i], a.q[i], kLane, kLane, kLane, kLane);
  return a;
}

// In each quad, transposes the 4x4 matrix with rows a, b, c, d: lane j of row i becomes lane i of row j.
GAUSSLITE_INLINE void transpose_within_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  GAUSSLITE_FOR_EACH_QUAD {
    const Quad ac_lo = __builtin_shufflevector(a.q[i], c.q[i], 0, 4, 1, 5);
    const Quad ac_hi = __builtin_shufflevector(a.q[i], c.q[i], 2, 6, 3, 7);
    const Quad bd_lo = __builtin_shufflevector(b.q[i], d.q[i], 0, 4, 1, 5);
    const Quad bd_hi = __builtin_shufflevector(b.q[i], d.q[i], 2, 6, 3, 7);
    a.q[i] = __builtin_shufflevector(ac_lo, bd_lo, 0, 4, 1, 5);
    b.q[i] = __builtin_shufflevector(ac_lo, bd_lo, 2, 6, 3, 7);
    c.q[i] = __builtin_shufflevector(ac_hi, bd_hi, 0, 4, 1, 5);
    d.q[i] = __builtin_shufflevector(ac_hi, bd_hi, 2, 6, 3, 7);
  }
}

// Transposes the 4x4 matrix of quads with rows a, b, c, d: quad j of row i becomes quad i of row j.
GAUSSLITE_INLINE void transpose_whole_quads(Pack16& a, Pack16& b, Pack16& c, Pack16& d) {
  Pack16* rows[4] = {&a, &b, &c, &d};
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < i; ++j) {
      const Quad q = rows[i]->q[j];
      rows[i]->q[j] = rows[j]->q[i];
      rows[j]->q[i] = q;
    }
  }
}

// A 4x4 block of pixels: four rows of four, `stride` floats apart.
GAUSSLITE_INLINE Pack16 load_block(const float* p, int64_t stride) {
  Pack16 a;
  GAUSSLITE_FOR_EACH_QUAD a.q[i] = load_quad(p + i * stride);
  return a;
}
// Sixteen bytes as floats from 0 to 255: a block of four rows of four (load_byte_block), or contiguous (load_bytes).
GAUSSLITE_INLINE Pack16 load_byte_block(const uint8_t* p, int64_t stride) {
  Pack16 a;
  for (int i = 0; i < 16; ++i) a.q[i / 4][i % 4] = float(p[i / 4 * stride + i % 4]);
  return a;
}
GAUSSLITE_INLINE Pack16 load_bytes(const uint8_t* p) { return load_byte_block(p, 4); }
GAUSSLITE_INLINE void store_block(float* p, int64_t stride, Pack16 a) {
  GAUSSLITE_FOR_EACH_QUAD store_quad(p + i * stride, a.q[i]);
}

#undef GAUSSLITE_FOR_EACH_QUAD

// Eight floats.
struct Pack8 {
  Quad lo, hi;
  Pack8() = default;
  GAUSSLITE_INLINE Pack8(Quad a, Quad b) : lo(a), hi(b) {}
  GAUSSLITE_INLINE Pack8(float x) : lo(quad(x)), hi(quad(x)) {}
};

GAUSSLITE_INLINE Pack8 load8(const float* p) { return {load_quad(p), load_quad(p + 4)}; }
GAUSSLITE_INLINE void store8(float* p, Pack8 a) {
  store_quad(p, a.lo);
  store_quad(p + 4, a.hi);
}
// p[0], p[1], p[0], p[1], ...
GAUSSLITE_INLINE Pack8 broadcast_pair(const float* p) {
  const Quad pairs{p[0], p[1], p[0], p[1]};
  return {pairs, pairs};
}
GAUSSLITE_INLINE Pack8 operator+(Pack8 a, Pack8 b) { return {a.lo + b.lo, a.hi + b.hi}; }
GAUSSLITE_INLINE Pack8 operator-(Pack8 a, Pack8 b) { return {a.lo - b.lo, a.hi - b.hi}; }
GAUSSLITE_INLINE Pack8 operator*(Pack8 a, Pack8 b) { return {a.lo * b.lo, a.hi * b.hi}; }
GAUSSLITE_INLINE Pack8 fma(Pack8 a, Pack8 b, Pack8 c) { return {a.lo * b.lo + c.lo, a.hi * b.hi + c.hi}; }
GAUSSLITE_INLINE Pack8 fnma(Pack8 a, Pack8 b, Pack8 c) { return c - a * b; }

// Lane k of the result is the lane of x that the k-th argument names.
template <int a, int b, int c, int d, int e, int f, int g, int h>
GAUSSLITE_INLINE Pack8 permute(Pack8 x) {
  return {__builtin_shufflevector(x.lo, x.hi, a, b, c, d), __builtin_shufflevector(x.lo, x.hi, e, f, g, h)};
}

// Lanes 0-3: the sum of the four quads, lane by lane; lanes 4-7: 0.
GAUSSLITE_INLINE Pack8 sum_of_quads(Pack16 a) { return {(a.q[0] + a.q[2]) + (a.q[1] + a.q[3]), quad(0.0f)}; }

// out[k]: quad k of a, followed by quad k of b.
GAUSSLITE_INLINE void pair_quads(Pack16 a, Pack16 b, Pack8 (&out)[4]) {
  for (int k = 0; k < 4; ++k) out[k] = {a.q[k], b.q[k]};
}

// The first eight floats of a pack (lower), the last eight (upper), and a pack of two such halves (join).
GAUSSLITE_INLINE Pack8 lower(Pack16 a) { return {a.q[0], a.q[1]}; }
GAUSSLITE_INLINE Pack8 upper(Pack16 a) { return {a.q[2], a.q[3]}; }
GAUSSLITE_INLINE Pack16 join(Pack8 lo, Pack8 hi) {
  Pack16 a;
  a.q[0] = lo.lo;
  a.q[1] = lo.hi;
  a.q[2] = hi.lo;
  a.q[3] = hi.hi;
  return a;
}

}  // namespace gausslite::GAUSSLITE_ISA
