// The kernels of the exact engine for waveforms and detectors whose avalanches leave something behind: afterpulses
// and twilight pulses. For every mode of the detector.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_avalanche_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kAvalanches>(block); }

}  // namespace mars
