"""
A rendered transient through a SPAD to a reconstruction
=======================================================

A renderer gives light over time for each pixel, here a wall with a later second bounce. It is scaled to photons,
convolved with the pulse and registered by a pixel with dead time. The generalised Coates correction recovers it
without a model of the light, apart from the noise of bins that were seldom armed. The program prints
``The second bounce: 17% of its photons registered.``

How-to: :doc:`/transients`. Theory: :doc:`/theory_reconstruction`.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml
from mars_lidar.reconstruction import GeneralisedCoates

y, x = np.mgrid[-1:1:24j, -1:1:32j]
after_ns = 0.1 * np.arange(600) - (15 + 6 * (x**2 + y**2))[..., None]  # since the wall's return
light = np.exp(-0.5 * (after_ns / 0.2) ** 2) + np.where(after_ns > 4, 0.02 * np.exp(-(after_ns - 4) / 6), 0)

pulse, detector = ml.GaussianPulse(sigma_ns=0.3), ml.Detector(dead_time_ns=40.0)
system = ml.System(period_ns=60.0, cycles=20_000, bins=300, pulse=pulse, detector=detector)
flux = ml.Flux.from_transient(light, system, bin_ns=0.1, signal=2.0, sbr=20.0)
counts = ml.simulate(flux, system, seed=0)[0]
rates = GeneralisedCoates().rates(counts, system)

fig, (pixel, image) = plt.subplots(1, 2, width_ratios=(2, 1))
pixel.plot(system.time_ns, counts[12, 16] / system.cycles, label="registered, per period")
pixel.plot(system.time_ns, rates[12, 16], label="generalised Coates")
pixel.set(xlabel="time (ns)", ylabel="photons per bin and period")
pixel.set_yscale("symlog", linthresh=1 / system.cycles)  # a count; zeros have a place
pixel.legend()
depth_m = 0.1499 * system.bin_ns * rates.argmax(-1)
image.set(xlabel="column", ylabel="row")
fig.colorbar(image.imshow(depth_m), label="depth of the fullest bin (m)", orientation="horizontal")
plt.show()
late = slice(130, 250)
share = counts[..., late].mean() / system.cycles / rates[..., late].mean()
print(f"The second bounce: {share:.0%} of its photons registered.")
