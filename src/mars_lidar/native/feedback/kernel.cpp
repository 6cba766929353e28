// The feedback engine at one vector level: a batch of lanes (feedback/integer_draws.h), each of which draws exposures of a
// pixel of its own.
#include "feedback/check.h"
#include "feedback/integer_draws.h"

namespace mars {

bool MARS_JOIN(feedback_kernel_, MARS_LEVEL)(const FeedbackBatch& batch) { return Batch(batch).run(); }
void MARS_JOIN(feedback_check_, MARS_LEVEL)(const FeedbackCheck& check) { GridCheck(check).run(); }

}  // namespace mars
