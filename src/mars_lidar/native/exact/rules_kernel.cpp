// The exact engine's kernels of all other pixels: those of the other modes of a detector (paralyzable, synchronous,
// gated: docs/detectors.md), whose registrations are recorded as they are; those with electronics between a
// registration and its record (exact/recorder.h); and those whose avalanches leave something behind, afterpulses
// (exact/trap_law.h) and twilight pulses.
#include "exact/runner.h"

namespace mars {

void MARS_JOIN(exact_modes_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    Runner<AnyRule, Stage::kPlain>(block).run();
}

void MARS_JOIN(exact_recording_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    Runner<AnyRule, Stage::kRecording>(block).run();
}

void MARS_JOIN(exact_avalanche_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    Runner<AnyRule, Stage::kAvalanches>(block).run();
}

}  // namespace mars
