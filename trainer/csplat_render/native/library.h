// SPDX-License-Identifier: Apache-2.0
// The interface to Python: C functions that take pointers to arrays, 64-bit integers and doubles; see kernels.py.
//
// The first argument of a function that runs on threads is their number. Each returns a result of at least 0, or −1 if
// there is not enough memory.
#pragma once

#include <cstdint>
#include <exception>

#ifdef _WIN32
#define CSPLAT_API extern "C" __declspec(dllexport)
#else
#define CSPLAT_API extern "C" __attribute__((visibility("default")))
#endif

namespace csplat {

// Returns the result of a function, or −1 if it throws.
template <typename Function>
int64_t guarded(Function&& function) {
  try {
    return function();
  } catch (const std::exception&) {
    return -1;
  }
}

}  // namespace csplat
