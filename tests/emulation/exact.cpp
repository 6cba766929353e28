// The kernel of the exact engine (cuda/exact.h), run on the processor.
#include "cuda/exact.h"

#include <cstdio>

#include "exact/step.h"
#include "launch.h"

namespace mars {
namespace {

using Kernel = void (*)(DeviceTask);

template <int32_t mode, bool gaussian, bool whole, bool single>
Kernel of_sink(DeviceSink sink) {
    switch (sink) {
        case DeviceSink::kCounts:
            return exact_items<mode, gaussian, whole, single, 0, kAhead>;
        case DeviceSink::kBlock16:
            return exact_items<mode, gaussian, whole, single, 1, kAhead>;
        case DeviceSink::kBlock32:
            return exact_items<mode, gaussian, whole, single, 2, kAhead>;
        case DeviceSink::kRows16:
            return exact_items<mode, gaussian, whole, single, 3, kAhead>;
        case DeviceSink::kRows32:
            return exact_items<mode, gaussian, whole, single, 4, kAhead>;
        case DeviceSink::kTimestamps:
            return exact_items<mode, gaussian, whole, single, 5, kAhead>;
    }
    return nullptr;
}

template <bool gaussian, bool single>
Kernel of_mode(DetectorMode mode, bool whole, DeviceSink sink) {
    switch (mode) {
        case DetectorMode::kNonparalyzable:
            return whole ? of_sink<0, gaussian, true, single>(sink) : of_sink<0, gaussian, false, single>(sink);
        case DetectorMode::kParalyzable:
            return of_sink<1, gaussian, true, single>(sink);
        case DetectorMode::kSynchronous:
            return of_sink<2, gaussian, false, single>(sink);
        case DetectorMode::kGated:
            return of_sink<3, gaussian, true, single>(sink);
    }
    return nullptr;
}

Kernel kernel_named(const char* name) {
    int mode = 0, sink = 0, ahead = 0;
    char gaussian[8], whole[8], single[8];
    if (std::sscanf(name, "mars::exact_items<%d, %5[a-z], %5[a-z], %5[a-z], %d, %d>", &mode, gaussian, whole, single,
                    &sink, &ahead) != 6 ||
        ahead != kAhead || mode < 0 || mode > 3 || sink < 0 || sink > static_cast<int>(DeviceSink::kTimestamps))
        return nullptr;
    const auto is = [](const char* word) { return std::strcmp(word, "true") == 0; };
    const DetectorMode of = static_cast<DetectorMode>(mode);
    const DeviceSink to = static_cast<DeviceSink>(sink);
    if (is(gaussian))
        return is(single) ? of_mode<true, true>(of, is(whole), to) : of_mode<true, false>(of, is(whole), to);
    return is(single) ? of_mode<false, true>(of, is(whole), to) : of_mode<false, false>(of, is(whole), to);
}

}  // namespace
}  // namespace mars

extern "C" __attribute__((visibility("default"))) int exact_on_host(const char* name, const void* argument,
                                                                    int64_t size, int64_t blocks, int32_t lanes,
                                                                    int64_t shared) {
    using namespace mars;
    const Kernel kernel = kernel_named(name);
    if (!kernel) return kNoKernel;
    DeviceTask task;
    if (!read_argument(argument, size, task)) return kOtherArgument;
    HostLaunch{blocks, lanes, shared}(kernel, task, lanes);
    return kDone;
}
