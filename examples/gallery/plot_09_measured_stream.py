"""
A measured stream inspected, calibrated, validated
==================================================

A laboratory gives photon times (PTU, Photon-HDF5, .mat, .npz). `mars_lidar.calibrate` finds the light behind them,
and `mars_lidar.validate` asks whether the model predicts the stream. Here the stream is simulated and read back as a
stranger's would be; its pixel has afterpulses. The recovery after a photon shows them, and a model without them is
refused until they are told.
"""

import matplotlib.pyplot as plt

import mars_lidar as ml
from mars_lidar.calibrate import inspect
from mars_lidar.plot.stream import draw_counts, draw_recovery

pulse, afterpulsing = ml.GaussianPulse(sigma_ns=0.5), ml.Afterpulsing(probability=0.1, delay_ns=40.0)
detector = ml.Detector(dead_time_ns=40.0, afterpulsing=afterpulsing)
system = ml.System(period_ns=100.0, cycles=200_000, bins=500, pulse=pulse, detector=detector)
ml.simulate_timestamps(ml.Flux(0.1, 0.1, 30.0), system, seed=0).save("photons.npz", overwrite=True)

times = ml.Timestamps.load("photons.npz")
print(*inspect(times).problems, sep="\n")
plain = ml.validate(times, ml.calibrate(times, pulse="gaussian", dead_time_ns=40.0), cycles=400)
told = ml.validate(times, cycles=400, simulated=1000)  # with the detector that the file describes

fig, axes = plt.subplots(1, 3, figsize=(9.0, 3.0))
draw_recovery(axes[0], plain.recovery)
for ax, found, model in zip(axes[1:], (plain, told), ("without afterpulses", "with them"), strict=True):
    draw_counts(ax, found)
    ax.set_xlabel(f"registrations; model {model} {'holds' if found.consistent else 'is refused'}")
plt.show()
