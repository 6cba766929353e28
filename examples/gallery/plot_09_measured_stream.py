"""
A measured stream calibrated
============================

From the photon times of a laboratory (PTU, Photon-HDF5, .mat, .npz), `mars_lidar.calibrate` estimates light and
detector with errors, tests whether the model fits, and names effects outside of the model. Here the stream is
simulated, with afterpulses of which the model is not informed: they are detected and fitted.
"""

import matplotlib.pyplot as plt

import mars_lidar as ml
from mars_lidar.plot.stream import calibration_figure

pulse, afterpulsing = ml.GaussianPulse(sigma_ns=0.5), ml.Afterpulsing(probability=0.1, delay_ns=40.0)
detector = ml.Detector(dead_time_ns=40.0, afterpulsing=afterpulsing)
system = ml.System(period_ns=100.0, cycles=200_000, bins=500, pulse=pulse, detector=detector)
times = ml.simulate_timestamps(ml.Flux(0.1, 0.1, 30.0), system, seed=0)

result = ml.calibrate(times)
for name, estimate in result.estimates.items():
    print(f"{name:<28} {estimate}")
print(*result.suspects, result.verdict, sep="\n")

calibration_figure(result, "a pixel with afterpulses")
plt.show()
