// What a kernel asks of the machine it runs on: a GPU, or threads counted in a loop (tests/emulation), which lets
// the tests compare the bits of the same source without a GPU.
#pragma once
#include "lanes/lanes.h"

#if defined(__CUDACC__)
#define MARS_KERNEL __global__ void
#define MARS_UNROLL _Pragma("unroll")
#else
#define MARS_KERNEL inline void
#define MARS_UNROLL
#endif

namespace mars {
inline namespace MARS_LEVEL {

// Which thread of the launch this is.
struct DevicePlace {
    int64_t thread;  // of the whole launch
    int32_t lane;    // in its block
    int32_t lanes;   // of the block
};

#if defined(__CUDACC__)

MARS_INLINE DevicePlace device_place() {
    const int32_t lane = static_cast<int32_t>(threadIdx.x), lanes = static_cast<int32_t>(blockDim.x);
    return {static_cast<int64_t>(blockIdx.x) * lanes + lane, lane, lanes};
}
MARS_INLINE uint8_t* block_memory() {
    extern __shared__ __align__(16) uint8_t memory[];
    return memory;
}
// Without a result the hardware adds in the second-level cache and the thread does not wait.
MARS_INLINE void add_later(uint32_t* to, uint32_t n) { atomicAdd(to, n); }

#else

struct HostDevice {
    DevicePlace place;
    uint8_t* memory;
};
inline thread_local HostDevice host_device;

MARS_INLINE DevicePlace device_place() { return host_device.place; }
MARS_INLINE uint8_t* block_memory() { return host_device.memory; }
MARS_INLINE void add_later(uint32_t* to, uint32_t n) { *to += n; }

#endif

}  // namespace MARS_LEVEL
}  // namespace mars
