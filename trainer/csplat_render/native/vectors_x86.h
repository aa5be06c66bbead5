// SPDX-License-Identifier: Apache-2.0
// The types and operations of vectors.h for AVX2 with FMA, and for AVX-512.
#pragma once

#include <immintrin.h>

#include <cstdint>
#include <cstring>

namespace csplat {

#ifdef __AVX512F__

constexpr int kFloats = 16;  // lanes of a register of floats
struct Floats { __m512 v; };
struct Ints { __m512i v; };
using Mask = __mmask16;
#define CSPLAT_PS(name) _mm512_##name##_ps
#define CSPLAT_SI(name) _mm512_##name

#else

constexpr int kFloats = 8;
struct Floats { __m256 v; };
struct Ints { __m256i v; };
struct Mask { __m256 v; };
#define CSPLAT_PS(name) _mm256_##name##_ps
#define CSPLAT_SI(name) _mm256_##name

#endif

constexpr int kDoubles = 4;

struct Doubles { __m256d v; };
struct DoubleMask { __m256d v; };
struct Fours { __m128 v; };
struct Eights { __m256 v; };

// Doubles have four lanes with AVX-512, too: they are mostly divided, which wider registers do not do faster.
#define CSPLAT_PD(name) _mm256_##name##_pd
#define CSPLAT_ARITHMETIC(Vector, Number, OP)                                                   \
  inline Vector load(const Number* p) { return {OP(loadu)(p)}; }                                \
  inline void store(Number* p, Vector a) { OP(storeu)(p, a.v); }                                \
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

inline Floats negative(Floats a) { return {CSPLAT_PS(or)(a.v, CSPLAT_PS(set1)(-0.0f))}; }  // −|a|
inline DoubleMask at_least(Doubles a, Doubles b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_GE_OQ)}; }
inline DoubleMask above(Doubles a, Doubles b) { return {_mm256_cmp_pd(a.v, b.v, _CMP_GT_OQ)}; }
inline DoubleMask both(DoubleMask a, DoubleMask b) { return {_mm256_and_pd(a.v, b.v)}; }
inline Doubles select(DoubleMask m, Doubles a, Doubles b) { return {_mm256_blendv_pd(b.v, a.v, m.v)}; }
inline unsigned bits(DoubleMask m) { return static_cast<unsigned>(_mm256_movemask_pd(m.v)); }
inline Doubles load_doubles(const float* p) { return {_mm256_cvtps_pd(_mm_loadu_ps(p))}; }
inline Fours to_floats(Doubles a) { return {_mm256_cvtpd_ps(a.v)}; }
inline void store_floats(float* p, Doubles a) { _mm_storeu_ps(p, _mm256_cvtpd_ps(a.v)); }
inline Doubles rounded_to_float(Doubles a) { return {_mm256_cvtps_pd(_mm256_cvtpd_ps(a.v))}; }
inline Doubles ceiling(Doubles a) { return {_mm256_ceil_pd(a.v)}; }
inline Doubles floor(Doubles a) { return {_mm256_floor_pd(a.v)}; }
inline double first_lane(Doubles a) { return _mm256_cvtsd_f64(a.v); }
inline void store(float* p, Eights a) { _mm256_storeu_ps(p, a.v); }

inline Ints load(const int32_t* p) {
  Ints a;
  std::memcpy(&a.v, p, sizeof a.v);
  return a;
}
inline void store(int32_t* p, Ints a) { std::memcpy(p, &a.v, sizeof a.v); }
inline Ints all(int32_t a) { return {CSPLAT_SI(set1_epi32)(a)}; }
// Returns a sum and the products of both halves of each lane, which are 16-bit integers.
inline Ints add_products(Ints sum, Ints a, Ints b) {
  return {CSPLAT_SI(add_epi32)(sum.v, CSPLAT_SI(madd_epi16)(a.v, b.v))};
}

#ifdef __AVX512F__

inline Mask at_least(Floats a, Floats b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
inline Mask above(Ints a, Ints b) { return _mm512_cmpgt_epi32_mask(a.v, b.v); }
inline Mask equal(Ints a, Ints b) { return _mm512_cmpeq_epi32_mask(a.v, b.v); }
inline Ints select(Mask m, Ints a, Ints b) { return {_mm512_mask_blend_epi32(m, b.v, a.v)}; }
inline Floats select(Mask m, Floats a, Floats b) { return {_mm512_mask_blend_ps(m, b.v, a.v)}; }
inline Floats keep(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
inline Floats drop(Mask m, Floats a) { return {_mm512_maskz_mov_ps(static_cast<Mask>(~m), a.v)}; }
inline unsigned bits(Mask m) { return m; }
inline unsigned negative_lanes(Floats a) { return _mm512_movepi32_mask(_mm512_castps_si512(a.v)); }
// Returns a with the sign of b, or b if that is 0.
inline Floats sign_of(Floats b, Floats a) {
  const Mask some = _mm512_cmp_ps_mask(b.v, _mm512_setzero_ps(), _CMP_NEQ_UQ);
  const __m512 sign = _mm512_and_ps(b.v, _mm512_set1_ps(-0.0f));
  return {_mm512_mask_or_ps(b.v, some, a.v, sign)};
}

// Returns 2**n · a, where n is an integer in the low bits of `low`.
inline Floats add_to_exponent(Floats a, Floats low) {
  const __m512i exponent = _mm512_slli_epi32(_mm512_castps_si512(low.v), 23);
  return {_mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(a.v), exponent))};
}
// Returns a vector of groups of four floats.
inline Floats join(const Fours* fours) {
  return {_mm512_insertf32x8(_mm512_castps256_ps512(_mm256_set_m128(fours[1].v, fours[0].v)),
                             _mm256_set_m128(fours[3].v, fours[2].v), 1)};
}
// Returns a block's sums of lanes k and k + 8.
inline Eights fold(const Floats* parts) {
  return {_mm256_add_ps(_mm512_castps512_ps256(parts[0].v), _mm512_extractf32x8_ps(parts[0].v, 1))};
}

#else

inline Mask at_least(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
inline Mask above(Ints a, Ints b) { return {_mm256_castsi256_ps(_mm256_cmpgt_epi32(a.v, b.v))}; }
inline Mask equal(Ints a, Ints b) { return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(a.v, b.v))}; }
inline Ints select(Mask m, Ints a, Ints b) { return {_mm256_blendv_epi8(b.v, a.v, _mm256_castps_si256(m.v))}; }
inline Floats select(Mask m, Floats a, Floats b) { return {_mm256_blendv_ps(b.v, a.v, m.v)}; }
inline Floats keep(Mask m, Floats a) { return {_mm256_and_ps(m.v, a.v)}; }
inline Floats drop(Mask m, Floats a) { return {_mm256_andnot_ps(m.v, a.v)}; }
inline unsigned bits(Mask m) { return static_cast<unsigned>(_mm256_movemask_ps(m.v)); }
inline unsigned negative_lanes(Floats a) { return static_cast<unsigned>(_mm256_movemask_ps(a.v)); }
inline Floats sign_of(Floats b, Floats a) {
  const __m256 some = _mm256_cmp_ps(b.v, _mm256_setzero_ps(), _CMP_NEQ_UQ);
  const __m256 sign = _mm256_and_ps(b.v, _mm256_set1_ps(-0.0f));
  return {_mm256_blendv_ps(b.v, _mm256_or_ps(a.v, sign), some)};
}

inline Floats add_to_exponent(Floats a, Floats low) {
  const __m256i exponent = _mm256_slli_epi32(_mm256_castps_si256(low.v), 23);
  return {_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), exponent))};
}
inline Floats join(const Fours* fours) { return {_mm256_set_m128(fours[1].v, fours[0].v)}; }
inline Eights fold(const Floats* parts) { return {_mm256_add_ps(parts[0].v, parts[1].v)}; }

#endif

// Returns the sum of the 8 lanes of each of 8 registers: neighbours first, then neighbouring pairs, then the halves.
inline Eights sum_lanes(const Eights* v) {
  __m256 pairs[4], fours[2];
  for (int n = 0; n < 4; n++) {
    const __m256 odd = _mm256_blend_ps(v[2 * n + 1].v, v[2 * n].v, 0xAA);
    pairs[n] = _mm256_add_ps(_mm256_blend_ps(v[2 * n].v, v[2 * n + 1].v, 0xAA), _mm256_permute_ps(odd, 0xB1));
  }
  for (int n = 0; n < 2; n++)
    fours[n] = _mm256_add_ps(_mm256_blend_ps(pairs[2 * n], pairs[2 * n + 1], 0xCC),
                             _mm256_shuffle_ps(pairs[2 * n], pairs[2 * n + 1], 0x4E));
  return {_mm256_add_ps(_mm256_blend_ps(fours[0], fours[1], 0xF0), _mm256_permute2f128_ps(fours[0], fours[1], 0x21))};
}

// Returns the sum of the 8 lanes of a register, in the order of `sum_lanes`.
inline float sum_lanes(Eights a) {
  const __m256 pairs = _mm256_add_ps(a.v, _mm256_permute_ps(a.v, 0xB1));
  const __m256 fours = _mm256_add_ps(pairs, _mm256_permute_ps(pairs, 0x4E));
  return _mm_cvtss_f32(_mm_add_ss(_mm256_castps256_ps128(fours), _mm256_extractf128_ps(fours, 1)));
}

}  // namespace csplat
