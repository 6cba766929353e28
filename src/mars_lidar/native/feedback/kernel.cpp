// The feedback engine at one vector level: a batch of lanes.
#include "feedback/batch.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {

bool MARS_JOIN(feedback_kernel_, MARS_LEVEL)(const FeedbackBatch& batch) { return Batch(batch).run(); }

}  // namespace mars
