"""
Fog and glass
=============

The same wall in clear air, behind a pane of glass, and in fog. A pane adds a return to every pixel; fog scatters light
back from every depth in front of the wall and attenuates the wall's light. The early light also makes the pixel dead
when the wall's light arrives, so that the wall loses further counts. The program prints ``Counts of the wall: 76,903 in
clear air, 7,358 in fog.``

How-to: :doc:`/transients`.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml
from mars_lidar.scene import LayeredScene

pulse, detector = ml.GaussianPulse(sigma_ns=0.4), ml.Detector(dead_time_ns=60.0)
system = ml.System(period_ns=80.0, cycles=200_000, bins=400, pulse=pulse, detector=detector)
wall = ml.Scene(depth_m=np.full((1, 1), 7.0), reflectivity=np.full((1, 1), 0.5))
clear = wall.flux(system, signal=0.5, sbr=10.0)
pane = LayeredScene.behind_pane(wall, depth_m=2.5, reflectivity=0.2, transmission=0.8).flux(
    system, signal=0.5, sbr=10.0
)
fog = clear.in_fog(system, extinction_per_m=0.12, backscatter=1.0)

fig, ax = plt.subplots()
metres = 0.1499 * system.bin_ns * (np.arange(system.bins) + 0.5)
wall_counts = {}
for name, flux in {"clear air": clear, "behind glass": pane, "in fog": fog}.items():
    counts = ml.simulate(flux, system, seed=0)[0, 0, 0]
    wall_counts[name] = counts[np.abs(metres - 7) < 0.3].sum()
    ax.step(metres, counts, where="mid", lw=0.9, label=f"{name}: {counts.sum():,} counts")
ax.set(xlabel="depth (m)", ylabel="counts per bin", ylim=(-0.5, None))
ax.set_yscale("symlog", linthresh=1.0)  # zeros have a place
ax.legend()
plt.show()
print(f"Counts of the wall: {wall_counts['clear air']:,} in clear air, {wall_counts['in fog']:,} in fog.")
