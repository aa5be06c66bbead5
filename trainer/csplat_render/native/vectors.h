// SPDX-License-Identifier: Apache-2.0
// Vectors of floats and of four doubles with strict arithmetic, which gives the same bits on every processor.
//
// Data is laid out in blocks of 16 lanes. A block is one AVX-512 register of floats, two AVX2 registers, or four NEON
// registers, which are used in pairs. Every operation works on each lane alone and rounds as IEEE 754 requires, and
// sums across lanes have one order. Products are fused with sums only by `fma` and `fnma`: compile with
// -ffp-contract=off. `smaller` and `larger` return b if one of the values is NaN; `fma` returns a b + c, `fnma` c − a
// b.
#pragma once

#include <cstdint>
#include <initializer_list>

#if defined(__AVX2__) && !defined(CSPLAT_PORTABLE)
#include "vectors_x86.h"
#else
#include "vectors_portable.h"
#endif

namespace csplat {

constexpr int kBlock = 16;                // lanes of a block
constexpr int kParts = kBlock / kFloats;  // registers of a block of floats

typedef uint64_t Longs __attribute__((vector_size(32)));
inline Longs as_bits(Doubles a) { return reinterpret_cast<Longs>(a.v); }
inline Doubles as_doubles(Longs a) { return {reinterpret_cast<decltype(Doubles::v)>(a)}; }

inline Floats operator-(Floats a) { return all(-0.0f) - a; }
inline Doubles operator-(Doubles a) { return all(-0.0) - a; }

// Returns 2**x for −120 <= x < 127, with a relative error of 2e-7.
//
// 2**x = 2**n · 2**f with n an integer and |f| <= 1/2; 2**f is a polynomial fitted for minimal relative error. Adding
// 1.5 · 2**23 rounds x to n and leaves n in the low bits.
inline Floats exp2_within(Floats x) {
  const Floats magic = all(12582912.0f), shifted = x + magic, f = x - (shifted - magic);
  Floats p = all(0.0013275470569714626f);
  for (const float c : {0.009684186484357147f, 0.05550791318132806f, 0.24021906575261626f, 0.6931468253392489f,
                        1.0000001353333114f})
    p = fma(p, f, all(c));
  return add_to_exponent(p, shifted);
}

// Returns e**x for |x| < 700, with a relative error of 1e-14: as `exp2_within`, with the Taylor series of e**(f ln 2).
inline Doubles exp(Doubles x) {
  const Doubles magic = all(6755399441055744.0);  // 1.5 · 2**52
  const Doubles t = x * all(1.4426950408889634);
  const Doubles shifted = t + magic;
  const Doubles f = (t - (shifted - magic)) * all(0.6931471805599453);
  Doubles p = all(1.0 / 39916800.0);
  for (const double c : {1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0, 1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0,
                         1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0})
    p = fma(p, f, all(c));
  return as_doubles(as_bits(p) + (as_bits(shifted) << 52));
}

// Returns log2(x) for normal x > 0, with an absolute error of 1e-12.
//
// x = 2**n · m with √½ <= m < √2; log2(m) = 2 artanh(t) / ln 2 with t = (m − 1) / (m + 1), by its series.
inline Doubles log2(Doubles x) {
  const Longs biased = (as_bits(x) + (0x3FF0000000000000 - 0x3FE6A09E667F3BCD)) >> 52;
  const Doubles n = as_doubles(biased + 0x4330000000000000) -
                    all(4503599627370496.0 + 1023.0);  // integers added to the bits of 2**52
  const Doubles m = as_doubles(as_bits(x) - (biased << 52) + 0x3FF0000000000000);
  const Doubles t = (m - all(1.0)) / (m + all(1.0)), tt = t * t;
  Doubles p = all(1.0 / 13.0);
  for (const double c : {1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0}) p = fma(p, tt, all(c));
  return fma(t * all(2.8853900817779268), p, n);
}

inline double exp(double x) { return first_lane(exp(all(x))); }
inline double log2(double x) { return first_lane(log2(all(x))); }

}  // namespace csplat
