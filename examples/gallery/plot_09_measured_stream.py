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

import mars_lidar as ml

pulse, afterpulsing = ml.GaussianPulse(sigma_ns=0.5), ml.Afterpulsing(probability=0.05, delay_ns=100.0)
detector = ml.Detector(dead_time_ns=50.0, afterpulsing=afterpulsing)
system = ml.System(period_ns=100.0, cycles=200_000, bins=500, pulse=pulse, detector=detector)
times = ml.simulate_timestamps(ml.Flux(0.1, 0.1, 30.0), system, seed=1)

result = ml.calibrate(times)
for name, estimate in result.estimates.items():
    print(f"{name:<28} {estimate}")
print(*result.suspects, result.verdict, sep="\n")

curves = result.curves()
fig, axes = plt.subplots(1, 2, figsize=(8, 3.2))
for ax, what in zip(axes, ("interval", "phase"), strict=True):
    edges_ns = getattr(curves, f"{what}_edges_ns")
    ax.stairs(getattr(curves, f"{what}s"), edges_ns, fill=True, color="0.8", label="recorded")
    ax.stairs(getattr(curves, f"fitted_{what}s"), edges_ns, color="C0", label="fitted model")
    ax.set(yscale="log", ylim=(0.5, None), ylabel="registrations per bin")
axes[0].set_xlabel("time since the last registration (ns)")
axes[1].set_xlabel("time in the laser period (ns)")
axes[1].legend()
plt.show()
dead_time = result.estimates["dead_time_ns"]
detected = ", ".join(suspect.name for suspect in result.suspects if suspect.included)  # in the result
print(f"Detected: {detected}. Dead time {dead_time.value:.0f} ns, true {detector.dead_time_ns:.0f} ns.")
