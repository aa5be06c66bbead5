// SPDX-License-Identifier: Apache-2.0
// The types and operations of vectors.h by the vector types of GCC and Clang, which lower them to NEON, or to any other
// instruction set. Same bits as vectors_x86.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace csplat {

constexpr int kFloats = 8, kDoubles = 4;

typedef float FloatVector __attribute__((vector_size(32)));
typedef double DoubleVector __attribute__((vector_size(32)));
typedef int32_t IntVector __attribute__((vector_size(32)));
typedef int64_t LongVector __attribute__((vector_size(32)));

struct Floats { FloatVector v; };
struct Ints { IntVector v; };
struct Mask { IntVector v; };  // −1 or 0
struct Doubles { DoubleVector v; };
struct DoubleMask { LongVector v; };
typedef float FourVector __attribute__((vector_size(16)));
struct Fours { FourVector v; };
using Eights = Floats;

#define CSPLAT_ARITHMETIC(Vector, Number, Register, Bits, LANES)                                        \
  inline Vector load(const Number* p) {                                                                 \
    Vector a;                                                                                           \
    std::memcpy(&a.v, p, sizeof a.v);                                                                   \
    return a;                                                                                           \
  }                                                                                                     \
  inline void store(Number* p, Vector a) { std::memcpy(p, &a.v, sizeof a.v); }                          \
  inline Vector all(Number a) { return {a - Register{}}; }                                              \
  inline Vector operator+(Vector a, Vector b) { return {a.v + b.v}; }                                   \
  inline Vector operator-(Vector a, Vector b) { return {a.v - b.v}; }                                   \
  inline Vector operator*(Vector a, Vector b) { return {a.v * b.v}; }                                   \
  inline Vector operator/(Vector a, Vector b) { return {a.v / b.v}; }                                   \
  inline Vector smaller(Vector a, Vector b) { return {a.v < b.v ? a.v : b.v}; }                         \
  inline Vector larger(Vector a, Vector b) { return {a.v > b.v ? a.v : b.v}; }                          \
  inline Vector magnitude(Vector a) {                                                                   \
    return {reinterpret_cast<Register>(reinterpret_cast<Bits>(a.v) &                                    \
                                       ~reinterpret_cast<Bits>(all(-Number(0)).v))};                    \
  }                                                                                                     \
  inline Vector square_root(Vector a) {                                                                 \
    for (int n = 0; n < LANES; n++) a.v[n] = std::sqrt(a.v[n]);                                         \
    return a;                                                                                           \
  }                                                                                                     \
  inline Vector fma(Vector a, Vector b, Vector c) {                                                     \
    for (int n = 0; n < LANES; n++) c.v[n] = std::fma(a.v[n], b.v[n], c.v[n]);                          \
    return c;                                                                                           \
  }                                                                                                     \
  inline Vector fnma(Vector a, Vector b, Vector c) {                                                    \
    for (int n = 0; n < LANES; n++) c.v[n] = std::fma(-a.v[n], b.v[n], c.v[n]);                         \
    return c;                                                                                           \
  }

CSPLAT_ARITHMETIC(Floats, float, FloatVector, IntVector, 8)
CSPLAT_ARITHMETIC(Doubles, double, DoubleVector, LongVector, 4)

inline DoubleMask at_least(Doubles a, Doubles b) { return {a.v >= b.v}; }
inline DoubleMask above(Doubles a, Doubles b) { return {a.v > b.v}; }
inline DoubleMask both(DoubleMask a, DoubleMask b) { return {a.v & b.v}; }
inline Doubles select(DoubleMask m, Doubles a, Doubles b) { return {m.v ? a.v : b.v}; }
inline unsigned bits(DoubleMask m) {
  unsigned result = 0;
  for (int n = 0; n < kDoubles; n++) result |= static_cast<unsigned>(m.v[n] & 1) << n;
  return result;
}
inline Doubles load_doubles(const float* p) { return {DoubleVector{p[0], p[1], p[2], p[3]}}; }
inline Fours to_floats(Doubles a) { return {__builtin_convertvector(a.v, FourVector)}; }
inline void store_floats(float* p, Doubles a) {
  const Fours floats = to_floats(a);
  std::memcpy(p, &floats.v, sizeof floats.v);
}
// By vectors, because GCC 12 leaves the rounding of single lanes out.
inline Doubles rounded_to_float(Doubles a) { return {__builtin_convertvector(to_floats(a).v, DoubleVector)}; }
inline Doubles ceiling(Doubles a) {
  for (int n = 0; n < kDoubles; n++) a.v[n] = std::ceil(a.v[n]);
  return a;
}
inline Doubles floor(Doubles a) {
  for (int n = 0; n < kDoubles; n++) a.v[n] = std::floor(a.v[n]);
  return a;
}
inline double first_lane(Doubles a) { return a.v[0]; }

inline Ints load(const int32_t* p) {
  Ints a;
  std::memcpy(&a.v, p, sizeof a.v);
  return a;
}
inline void store(int32_t* p, Ints a) { std::memcpy(p, &a.v, sizeof a.v); }
inline Ints all(int32_t a) { return {a - IntVector{}}; }
inline Ints add_products(Ints sum, Ints a, Ints b) {
  return {sum.v + (a.v << 16 >> 16) * (b.v << 16 >> 16) + (a.v >> 16) * (b.v >> 16)};
}
inline Mask above(Ints a, Ints b) { return {a.v > b.v}; }
inline Mask equal(Ints a, Ints b) { return {a.v == b.v}; }
inline Ints select(Mask m, Ints a, Ints b) { return {m.v ? a.v : b.v}; }

inline Mask at_least(Floats a, Floats b) { return {a.v >= b.v}; }
inline Floats select(Mask m, Floats a, Floats b) { return {m.v ? a.v : b.v}; }
inline IntVector float_bits(Floats a) { return reinterpret_cast<IntVector>(a.v); }
inline Floats from_bits(IntVector a) { return {reinterpret_cast<FloatVector>(a)}; }
inline Floats keep(Mask m, Floats a) { return from_bits(m.v & float_bits(a)); }
inline Floats drop(Mask m, Floats a) { return from_bits(~m.v & float_bits(a)); }
inline unsigned bits(Mask m) {
  const IntVector weights = {1, 2, 4, 8, 16, 32, 64, 128};
  const IntVector set = m.v & weights;
  unsigned result = 0;
  for (int n = 0; n < kFloats; n++) result |= static_cast<unsigned>(set[n]);
  return result;
}
inline unsigned negative_lanes(Floats a) { return bits(Mask{float_bits(a) < 0}); }
inline Floats negative(Floats a) { return from_bits(float_bits(a) | INT32_MIN); }  // −|a|
inline Floats sign_of(Floats b, Floats a) {
  return {b.v != 0.0f ? from_bits(float_bits(a) | (float_bits(b) & INT32_MIN)).v : b.v};
}
inline Floats add_to_exponent(Floats a, Floats low) { return from_bits(float_bits(a) + (float_bits(low) << 23)); }
inline Floats join(const Fours* fours) {
  Floats a;
  std::memcpy(&a.v, fours, sizeof a.v);
  return a;
}
inline Eights fold(const Floats* parts) { return parts[0] + parts[1]; }

inline float sum_lanes(Eights a) {
  return ((a.v[0] + a.v[1]) + (a.v[2] + a.v[3])) + ((a.v[4] + a.v[5]) + (a.v[6] + a.v[7]));
}
inline Eights sum_lanes(const Eights* v) {
  Eights result;
  for (int n = 0; n < 8; n++) result.v[n] = sum_lanes(v[n]);
  return result;
}

}  // namespace csplat
