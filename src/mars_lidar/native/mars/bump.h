// Parts of a block of memory, one after the other, each aligned to a line of the cache.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Hands out the memory from `at` on. Nothing is given back, and nobody checks that there is enough: sizes are worked
// out beforehand.
struct Bump {
    char* at;
    template <class T>
    T* take(int64_t n) {
        T* const found = reinterpret_cast<T*>(at);
        at += (n * static_cast<int64_t>(sizeof(T)) + 63) / 64 * 64;
        return found;
    }
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
