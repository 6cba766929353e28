// The kernels of the exact engine for waveforms with a recorder between registrations and log (exact/recorder.h),
// for every mode of the detector.
#include "waveform/runner.h"

namespace mars {

void MARS_JOIN(waveform_recording_kernel_, MARS_LEVEL)(const WaveformBlock& block) { run<Stage::kRecording>(block); }

}  // namespace mars
