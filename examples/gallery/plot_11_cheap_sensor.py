"""
A cheap sensor
==============

The same room and light with an ideal detector and with one of a few euros: dark counts, jitter with a tail, optical
crosstalk, electronics that record one event a period, a converter with uneven codes. Each effect is an option of the
detector. The depth is that of the fullest bin.
The program prints ``Median depth error: 14 mm ideal, 33 mm cheap.``

How-to: :doc:`/detectors`. Theory: :doc:`/theory_detectors`.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml

flaws = {"dark_count_hz": 5e5, "max_events_per_period": 1, "crosstalk": ml.Crosstalk(probability=0.05)}
flaws |= {"jitter": ml.Jitter(sigma_ns=0.4, tail_ns=2.0, tail_fraction=0.3), "code_density": (1.6, 0.6, 1.1, 0.7)}
pulse, scene = ml.GaussianPulse(sigma_ns=0.3), ml.Scene.example("room", size=(72, 96))
errors_mm = {}
fig, axes = plt.subplots(2, 2, figsize=(8.2, 4.6), width_ratios=(1, 1.5))
for (image, plot), name, options in zip(axes, ("ideal", "cheap"), ({}, flaws), strict=True):
    detector = ml.Detector(dead_time_ns=20.0, **options)
    system = ml.System(period_ns=80.0, cycles=400, bins=256, pulse=pulse, detector=detector)
    cube = ml.simulate(scene.flux(system, signal=0.2, sbr=2.0), system, engine="sequential", seed=0)[0]
    depth_m = 0.1499 * system.bin_ns * (cube.argmax(-1) + 0.5)
    picture = image.imshow(depth_m, vmin=1, vmax=9)
    median_mm = errors_mm[name] = 1e3 * np.median(np.abs(depth_m - scene.depth_m))
    image.set(title=f"{name}: median error {median_mm:.0f} mm", xticks=[], yticks=[])
    plot.plot(system.time_ns, cube.mean((0, 1)), drawstyle="steps-mid", lw=0.8)
    plot.set(yscale="log", ylim=(0.05, 10), ylabel="mean counts per bin")
axes[1, 1].set(xlabel="time in the laser period (ns)")
fig.colorbar(picture, ax=axes[:, 0], label="depth of the fullest bin (m)", location="left")
plt.show()
print(f"Median depth error: {errors_mm['ideal']:.0f} mm ideal, {errors_mm['cheap']:.0f} mm cheap.")
