// Vectors of floats, as wide as the processor's registers, and of four doubles, with strict arithmetic.
//
// Data is laid out in blocks of 16 lanes. A block is one AVX-512 register of floats or two AVX2 registers. Doubles are
// mostly divided, which wider registers do not do faster. Every operation works on each lane alone and rounds as IEEE
// 754 requires, and sums across lanes have one order, so both instruction sets give the same bits. Products are fused
// with sums only by `fma` and `fnma`: compile with -ffp-contract=off.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace csplat {

constexpr int kBlock = 16;  // lanes of a block

#ifdef __AVX512F__

constexpr int kFloats = 16;  // lanes of a register of floats
struct Floats { __m512 v; };
using Mask = __mmask16;
#define CSPLAT_PS(name) _mm512_##name##_ps

#else

constexpr int kFloats = 8;
struct Floats { __m256 v; };
struct Mask { __m256 v; };
#define CSPLAT_PS(name) _mm256_##name##_ps

#endif

constexpr int kParts = kBlock / kFloats;  // registers of a block of floats
constexpr int kDoubles = 4;

struct Doubles { __m256d v; };
struct DoubleMask { __m256d v; };

#define CSPLAT_PD(name) _mm256_##name##_pd
// `smaller` and `larger` return b if one of the values is NaN; `fma` returns a b + c, `fnma` c − a b.
#define CSPLAT_ARITHMETIC(Vector, Number, OP)                                                   \
  inline Vector load(const Number* p) { return {OP(load)(p)}; }                                 \
  inline void store(Number* p, Vector a) { OP(store)(p, a.v); }                                 \
  inline Vector all(Number a) { return {OP(set1)(a)}; }                                         \
  inline Vector operator+(Vector a, Vector b) { return {OP(add)(a.v, b.v)}; }                   \
  inline Vector operator-(Vector a, Vector b) { return {OP(sub)(a.v, b.v)}; }                   \
  inline Vector operator*(Vector a, Vector b) { return {OP(mul)(a.v, b.v)}; }                   \
  inline Vector operator/(Vector a, Vector b) { return {OP(div)(a.v, b.v)}; }                   \
  inline Vector smaller(Vector a, Vector b) { return {OP(min)(a.v, b.v)}; }                     \
  inline Vector larger(Vector a, Vector b) { return {OP(max)(a.v, b.v)}; }                      \
  inline Vector square_root(Vector a) { return {OP(sqrt)(a.v)}; }                               \
  inline Vector magnitude(Vector a) { return {OP(andnot)(OP(set1)(-Number(0)), a.v)}; }         \
  inline Vector fma(Vector a, Vector b, Vector c) { return {OP(fmadd)(a.v, b.v, c.v)}; }        \
  inline Vector fnma(Vector a, Vector b, Vector c) { return {OP(fnmadd)(a.v, b.v, c.v)}; }

CSPLAT_ARITHMETIC(Floats, float, CSPLAT_PS)
CSPLAT_ARITHMETIC(Doubles, double, CSPLAT_PD)

inline DoubleMask at_least(Doubles a, Doubles b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_GE_OQ)}; }
inline DoubleMask above(Doubles a, Doubles b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_GT_OQ)}; }
inline DoubleMask both(DoubleMask a, DoubleMask b) { return {_mm256_and_pd(a.v, b.v)}; }
inline Doubles select(DoubleMask m, Doubles a, Doubles b) { return {_mm256_blendv_pd(b.v, a.v, m.v)}; }
inline unsigned bits(DoubleMask m) { return static_cast<unsigned>(_mm256_movemask_pd(m.v)); }
inline Doubles load_doubles(const float* p) { return {_mm256_cvtps_pd(_mm_load_ps(p))}; }
inline __m128 to_floats(Doubles a) { return _mm256_cvtpd_ps(a.v); }
inline void store_floats(float* p, Doubles a) { _mm_store_ps(p, to_floats(a)); }
inline Doubles rounded_to_float(Doubles a) { return {_mm256_cvtps_pd(_mm256_cvtpd_ps(a.v))}; }
inline Doubles ceiling(Doubles a) { return {_mm256_ceil_pd(a.v)}; }
inline Doubles floor(Doubles a) { return {_mm256_floor_pd(a.v)}; }

#ifdef __AVX512F__

inline Mask at_least(Floats a, Floats b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
inline Floats select(Mask m, Floats a, Floats b) { return {_mm512_mask_blend_ps(m, b.v, a.v)}; }
inline Floats keep(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
inline Floats drop(Mask m, Floats a) { return {_mm512_maskz_mov_ps(static_cast<Mask>(~m), a.v)}; }
inline unsigned bits(Mask m) { return m; }
inline unsigned negative_lanes(Floats a) { return _mm512_movepi32_mask(_mm512_castps_si512(a.v)); }
// Returns a with a negative sign in the lanes that are not in m.
inline Floats negate_outside(Mask m, Floats a) {
  return {_mm512_mask_or_ps(a.v, static_cast<Mask>(~m), a.v, _mm512_set1_ps(-0.0f))};
}

// Returns 2**n · a, where n is an integer in the low bits of `low`.
inline Floats add_to_exponent(Floats a, Floats low) {
  const __m512i exponent = _mm512_slli_epi32(_mm512_castps_si512(low.v), 23);
  return {_mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(a.v), exponent))};
}
// Returns a vector of groups of four floats.
inline Floats join(const __m128* fours) {
  return {_mm512_insertf32x8(_mm512_castps256_ps512(_mm256_set_m128(fours[1], fours[0])),
                             _mm256_set_m128(fours[3], fours[2]), 1)};
}
// Returns a block's sums of lanes k and k + 8.
inline __m256 fold(const Floats* parts) {
  return _mm256_add_ps(_mm512_castps512_ps256(parts[0].v), _mm512_extractf32x8_ps(parts[0].v, 1));
}

#else

inline Mask at_least(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
inline Floats select(Mask m, Floats a, Floats b) { return {_mm256_blendv_ps(b.v, a.v, m.v)}; }
inline Floats keep(Mask m, Floats a) { return {_mm256_and_ps(m.v, a.v)}; }
inline Floats drop(Mask m, Floats a) { return {_mm256_andnot_ps(m.v, a.v)}; }
inline unsigned bits(Mask m) { return static_cast<unsigned>(_mm256_movemask_ps(m.v)); }
inline unsigned negative_lanes(Floats a) { return static_cast<unsigned>(_mm256_movemask_ps(a.v)); }
inline Floats negate_outside(Mask m, Floats a) {
  return {_mm256_or_ps(a.v, _mm256_andnot_ps(m.v, _mm256_set1_ps(-0.0f)))};
}

inline Floats add_to_exponent(Floats a, Floats low) {
  const __m256i exponent = _mm256_slli_epi32(_mm256_castps_si256(low.v), 23);
  return {_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), exponent))};
}
inline Floats join(const __m128* fours) { return {_mm256_set_m128(fours[1], fours[0])}; }
inline __m256 fold(const Floats* parts) { return _mm256_add_ps(parts[0].v, parts[1].v); }

#endif

// Returns 2**x for x < 127, with a relative error of 2e-7; smaller x than −120 count as −120.
//
// 2**x = 2**n · 2**f with n an integer and |f| <= 1/2; 2**f is a polynomial fitted for minimal relative error. Adding
// 1.5 · 2**23 rounds x to n and leaves n in the low bits.
inline Floats exp2(Floats x) {
  const Floats magic = all(12582912.0f), t = larger(x, all(-120.0f)), shifted = t + magic, f = t - (shifted - magic);
  Floats p = all(0.0013275470569714626f);
  for (const float c : {0.009684186484357147f, 0.05550791318132806f, 0.24021906575261626f, 0.6931468253392489f,
                        1.0000001353333114f})
    p = fma(p, f, all(c));
  return add_to_exponent(p, shifted);
}

inline __m256i as_bits(Doubles a) { return _mm256_castpd_si256(a.v); }
inline Doubles as_doubles(__m256i a) { return {_mm256_castsi256_pd(a)}; }

// Returns e**x for |x| < 700, with a relative error of 1e-14: as `exp2`, with the Taylor series of e**(f ln 2).
inline Doubles exp(Doubles x) {
  const Doubles magic = all(6755399441055744.0);  // 1.5 · 2**52
  const Doubles t = x * all(1.4426950408889634);
  const Doubles shifted = t + magic;
  const Doubles f = (t - (shifted - magic)) * all(0.6931471805599453);
  Doubles p = all(1.0 / 39916800.0);
  for (const double c : {1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0, 1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0,
                         1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0})
    p = fma(p, f, all(c));
  return as_doubles(_mm256_add_epi64(as_bits(p), _mm256_slli_epi64(as_bits(shifted), 52)));
}

// Returns log2(x) for normal x > 0, with an absolute error of 1e-12.
//
// x = 2**n · m with √½ <= m < √2; log2(m) = 2 artanh(t) / ln 2 with t = (m − 1) / (m + 1), by its series.
inline Doubles log2(Doubles x) {
  const __m256i shifted = _mm256_add_epi64(as_bits(x), _mm256_set1_epi64x(0x3FF0000000000000 - 0x3FE6A09E667F3BCD));
  const __m256i biased = _mm256_srli_epi64(shifted, 52);
  const Doubles n = as_doubles(_mm256_add_epi64(biased, _mm256_set1_epi64x(0x4330000000000000))) -
                    all(4503599627370496.0 + 1023.0);  // integers added to the bits of 2**52
  const __m256i fraction = _mm256_sub_epi64(as_bits(x), _mm256_slli_epi64(biased, 52));
  const Doubles m = as_doubles(_mm256_add_epi64(fraction, _mm256_set1_epi64x(0x3FF0000000000000)));
  const Doubles t = (m - all(1.0)) / (m + all(1.0)), tt = t * t;
  Doubles p = all(1.0 / 13.0);
  for (const double c : {1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0}) p = fma(p, tt, all(c));
  return fma(t * all(2.8853900817779268), p, n);
}

// Returns the sum of the 8 lanes of each of 8 registers: neighbours first, then neighbouring pairs, then the halves.
inline __m256 sum_lanes(const __m256* v) {
  __m256 pairs[4], fours[2];
  for (int n = 0; n < 4; n++) {
    const __m256 odd = _mm256_blend_ps(v[2 * n + 1], v[2 * n], 0xAA);
    pairs[n] = _mm256_add_ps(_mm256_blend_ps(v[2 * n], v[2 * n + 1], 0xAA), _mm256_permute_ps(odd, 0xB1));
  }
  for (int n = 0; n < 2; n++)
    fours[n] = _mm256_add_ps(_mm256_blend_ps(pairs[2 * n], pairs[2 * n + 1], 0xCC),
                             _mm256_shuffle_ps(pairs[2 * n], pairs[2 * n + 1], 0x4E));
  return _mm256_add_ps(_mm256_blend_ps(fours[0], fours[1], 0xF0), _mm256_permute2f128_ps(fours[0], fours[1], 0x21));
}

// Returns the sum of the 8 lanes of a register, in the order of `sum_lanes`.
inline float sum_lanes(__m256 v) {
  const __m256 pairs = _mm256_add_ps(v, _mm256_permute_ps(v, 0xB1));
  const __m256 fours = _mm256_add_ps(pairs, _mm256_permute_ps(pairs, 0x4E));
  return _mm_cvtss_f32(_mm_add_ss(_mm256_castps256_ps128(fours), _mm256_extractf128_ps(fours, 1)));
}

}  // namespace csplat
