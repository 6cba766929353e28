// The kernels of the exact engine for waveforms, for every mode of the detector: registrations recorded as they are,
// by a recorder (exact/recorder.h), and those of detectors whose avalanches leave afterpulses and twilight pulses.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kPlain>(block); }
void MARS_JOIN(waveform_recording_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kRecording>(block); }
void MARS_JOIN(waveform_avalanche_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kAvalanches>(block); }

}  // namespace mars
