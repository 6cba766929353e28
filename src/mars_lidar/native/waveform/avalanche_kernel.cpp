// The kernels of waveforms for detectors whose avalanches leave something behind, for every mode.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_avalanche_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kAvalanches>(block); }

}  // namespace mars
