// A launch of a GPU's kernel as a loop on the processor: blocks one after another, threads of each one after another. The
// tests compare the bits of the same source with those of the engines, without a GPU.
#pragma once
#include <algorithm>
#include <cstring>
#include <vector>

#include "cuda/device.h"

namespace mars {

// What a call of C may return.
enum Outcome : int { kDone = 0, kNoKernel = 1, kOtherArgument = 2 };

// The argument of a kernel from the bytes that the package makes of it; false where they are not as many.
template <class Task>
bool read_argument(const void* bytes, int64_t size, Task& task) {
    if (size != static_cast<int64_t>(sizeof(Task))) return false;
    std::memcpy(&task, bytes, sizeof task);
    return true;
}

inline namespace MARS_LEVEL {

// Blocks one after another, `at_once` threads of each; the blocks' memory holds anything when one begins.
struct HostLaunch {
    int64_t blocks;
    int32_t lanes;
    int64_t shared;

    template <class Kernel, class Task>
    void operator()(const Kernel& kernel, const Task& task, int32_t at_once) const {
        std::vector<uint64_t> memory(static_cast<size_t>(shared / 8 + 16));
        uint8_t* const begin = reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) / 64 * 64);
        for (int64_t block = 0; block < blocks; ++block) {
            std::fill(memory.begin(), memory.end(), 0xdeadbeefdeadbeefu);
            for (int32_t lane = 0; lane < at_once; ++lane) {
                host_device = {{block * lanes + lane, lane, lanes}, begin};
                kernel(task);
            }
        }
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
