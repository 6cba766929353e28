"""
A measured stream calibrated
============================

From the photon times of a laboratory (PTU, Photon-HDF5, .mat, .npz), `mars_lidar.calibrate` estimates light and
detector with errors, tests whether the model fits, and names effects outside of the model. Here the stream is
simulated, with afterpulses of which the model is not informed: they are detected and fitted. Left, the times between
successive registrations: none within the dead time, and a slow decay after it. Right, the times in the laser period.
The program prints ``Detected: afterpulses. Dead time 50 ns, true 50 ns.``

How-to: :doc:`/calibration`. Theory: :doc:`/calibration_method`.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml

pulse, afterpulsing = ml.GaussianPulse(sigma_ns=0.5), ml.Afterpulsing(probability=0.05, delay_ns=100.0)
detector = ml.Detector(dead_time_ns=50.0, afterpulsing=afterpulsing)
system = ml.System(period_ns=100.0, cycles=200_000, bins=500, pulse=pulse, detector=detector)
times = ml.simulate_timestamps(ml.Flux(0.1, 0.1, 30.0), system, seed=1)

result = ml.calibrate(times)
for name, estimate in result.estimates.items():
    print(f"{name:<28} {estimate}")
print(*result.suspects, result.verdict, sep="\n")

fitted = ml.simulate_timestamps(result.flux, result.system, seed=2)
fig, axes = plt.subplots(1, 2, figsize=(8, 3.2))
recorded_style, fitted_style = (
    {"fill": True, "color": "0.8", "label": "recorded"},
    {"color": "C0", "label": "fitted model"},
)
for stream, style in ((times, recorded_style), (fitted, fitted_style)):
    axes[0].stairs(*np.histogram(np.diff(stream.times_ns), 200, (0.0, 3500.0)), **style)
    axes[1].stairs(*np.histogram(stream.times_ns % system.period_ns, 250, (0.0, system.period_ns)), **style)
for ax, label in zip(axes, ("time since the last registration (ns)", "time in the laser period (ns)"), strict=True):
    ax.set(xlabel=label, yscale="log", ylim=(0.5, None), ylabel="registrations per bin")
axes[1].legend()
plt.show()
dead_time = result.estimates["dead_time_ns"]
detected = ", ".join(suspect.name for suspect in result.suspects if suspect.included)  # in the result
print(f"Detected: {detected}. Dead time {dead_time.value:.0f} ns, true {detector.dead_time_ns:.0f} ns.")
