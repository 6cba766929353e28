// The kernels of waveforms with a recorder between registrations and log (recorder.h), for every mode of the detector.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_recording_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kRecording>(block); }

}  // namespace mars
