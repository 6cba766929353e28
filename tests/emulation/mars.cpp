// The kernels of the engine "mars" (cuda/mars.h), run on the processor: one thread stands for a block that shares a pixel.
#include "cuda/mars.h"

#include <string>

#include "launch.h"

extern "C" __attribute__((visibility("default"))) int mars_on_host(const char* name, const void* argument, int64_t size,
                                                                   int64_t blocks, int32_t lanes, int64_t shared) {
    using namespace mars;
    const std::string kernel = name;
    const HostLaunch launch{blocks, lanes, shared};
    MarsLawTask laws;
    MarsTask task;
    if (kernel == "mars::mars_laws") {
        if (!read_argument(argument, size, laws)) return kOtherArgument;
        launch(mars_laws, laws, lanes);
        return kDone;
    }
    if (kernel != "mars::mars_histograms<false>" && kernel != "mars::mars_histograms<true>") return kNoKernel;
    if (!read_argument(argument, size, task)) return kOtherArgument;
    if (kernel == "mars::mars_histograms<false>")
        launch(mars_histograms<false>, task, 1);
    else
        launch(mars_histograms<true>, task, 1);
    return kDone;
}
