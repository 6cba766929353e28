// The kernel of the feedback engine (cuda/feedback.h), run on the processor.
#define MARS_LEVEL one_lane  // whose batches are not those of other files
#include "cuda/feedback.h"

#include <string>

#include "launch.h"

extern "C" __attribute__((visibility("default"))) int feedback_on_host(const char* name, const void* argument,
                                                                       int64_t size, int64_t blocks, int32_t lanes,
                                                                       int64_t shared) {
    using namespace mars;
    const std::string kernel = name;
    if (kernel != "mars::feedback_histograms<false>" && kernel != "mars::feedback_histograms<true>") return kNoKernel;
    FeedbackTask task;
    if (!read_argument(argument, size, task)) return kOtherArgument;
    const HostLaunch launch{blocks, lanes, shared};
    if (kernel == "mars::feedback_histograms<false>")
        launch(feedback_histograms<false>, task, lanes);
    else
        launch(feedback_histograms<true>, task, lanes);
    return kDone;
}
