// SPDX-License-Identifier: Apache-2.0
// Functions about the library itself. Compiled for any processor, so that an unsupported one can call them.
#include "library.h"

#include "threads.h"

#ifdef __x86_64__
#include <cpuid.h>
#endif

using namespace csplat;

// Returns 1 if the processor has the instructions that the other functions use, and the system keeps their registers.
CSPLAT_API int64_t csplat_supported() {
#if defined(CSPLAT_AVX512) || defined(CSPLAT_AVX2)
  unsigned basic = bit_FMA | bit_MOVBE | bit_POPCNT | bit_OSXSAVE | bit_AVX | bit_F16C;
  unsigned more = bit_AVX2 | bit_BMI | bit_BMI2, registers = 0x06;
#ifdef CSPLAT_AVX512
  more |= bit_AVX512F | bit_AVX512BW | bit_AVX512CD | bit_AVX512DQ | bit_AVX512VL, registers |= 0xE0;
#endif
  constexpr unsigned kLzcnt = 0x20;
  unsigned a, b, c, d, kept;
  if (!__get_cpuid(1, &a, &b, &c, &d) || (c & basic) != basic) return 0;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & more) != more) return 0;
  if (!__get_cpuid(0x80000001, &a, &b, &c, &d) || !(c & kLzcnt)) return 0;
  asm("xgetbv" : "=a"(kept), "=d"(d) : "c"(0));
  return (kept & registers) == registers;
#else
  return 1;
#endif
}

// Gives a forked child threads of its own.
CSPLAT_API int64_t csplat_forget_threads() {
  Threads::forget();
  return 0;
}
