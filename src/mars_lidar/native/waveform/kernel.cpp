// The kernels of the exact engine for waveforms that record every registration as it is, for every mode of the
// detector.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kPlain>(block); }

}  // namespace mars
