"""
The joint law, and why count times shape is not enough
======================================================

Dead time correlates the bins of a histogram. Simulators that draw a count and distribute it over the mean shape (MaRS,
and every multinomial) have the right mean of each bin and the right count, but the wrong covariance: a registration
excludes others less than a dead time away. `mars_lidar.joint_law` gives the covariance exactly. The program
prints ``Variance of the counts at the pulse: 157 by the exact law, 109 by count times shape.``

Theory: :doc:`/joint_law`.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml

pulse, detector = ml.GaussianPulse(sigma_ns=2.0), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=100.0, cycles=500, bins=50, pulse=pulse, detector=detector)
flux = ml.Flux(signal=2.0, background=1.0, delay_ns=40.0)
covariances = {"exact law": ml.joint_law(flux, system).covariance()}
for engine in ("exact", "mars"):
    cube = ml.simulate(flux, system, engine=engine, realizations=20_000, seed=0)
    covariances[f"engine {engine!r}, 20,000 draws"] = np.cov(cube.reshape(-1, system.bins).T)

windows = {}
fig, axes = plt.subplots(1, 3, figsize=(8.4, 3.0), sharey=True)
for ax, (name, covariance) in zip(axes, covariances.items(), strict=True):
    image = ax.imshow(covariance, cmap="RdBu_r", vmin=-2, vmax=2, extent=(0, 100, 100, 0))
    window = windows[name] = covariance[17:24, 17:24].sum()
    ax.set(title=f"{name}\nvariance at the pulse: {window:.0f}", xlabel="time (ns)")
axes[0].set(ylabel="time (ns)")
fig.colorbar(image, ax=axes, label="covariance (counts²)", shrink=0.8)
plt.show()
exact, _, mars = windows.values()
print(f"Variance of the counts at the pulse: {exact:.0f} by the exact law, {mars:.0f} by count times shape.")
