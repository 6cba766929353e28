// The kernels of waveforms: every mode of the detector, every registration recorded as it is.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kPlain>(block); }

}  // namespace mars
