"""
A piled-up histogram corrected
==============================

Two thirds of the light are background, and a free-running pixel with a dead time of 75 ns distorts it: bins after a
bright one are seldom armed. Coates' correction is for a detector that is armed at the start of each period, and fails
here. The generalised correction counts in how many periods each bin was armed; maximum likelihood uses the pulse, too.
The program prints ``Registered 0.92 photons per period; fitted 3.00, true 3.00.``

Theory: :doc:`/theory_reconstruction`.
"""

import matplotlib.pyplot as plt

import mars_lidar as ml
from mars_lidar.reconstruction import Coates, GeneralisedCoates

pulse, detector = ml.GaussianPulse(sigma_ns=1.0), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=100.0, cycles=50_000, bins=128, pulse=pulse, detector=detector)
synchronous = system.replace(detector=ml.Detector(dead_time_ns=75.0, mode="synchronous"))
counts = ml.simulate(ml.Flux(1.0, 2.0, 60.0), system, seed=0)[0, 0, 0]
estimate = ml.reconstruct(counts, system)
light = ml.Flux(estimate.signal, estimate.background, estimate.delay_ns)
fitted = ml.statistics.photons_per_bin(light, system).reshape(system.bins, -1).sum(-1)

fig, ax = plt.subplots()
ax.step(system.time_ns, counts / system.cycles, where="mid", color="0.7", label="registered")
ax.plot(system.time_ns, Coates().rates(counts, synchronous), label="Coates")
ax.plot(system.time_ns, GeneralisedCoates().rates(counts, system), label="generalised Coates")
ax.plot(system.time_ns, fitted, label=f"maximum likelihood: S = {estimate.signal:.3f}, B = {estimate.background:.3f}")
ax.set(xlabel="time in the laser period (ns)", ylabel="photons per bin and period", yscale="log", ylim=(None, 3))
ax.legend(ncols=2, loc="upper left")
plt.show()
rate, fit = counts.sum() / system.cycles, estimate.signal + estimate.background
print(f"Registered {rate:.2f} photons per period; fitted {fit:.2f}, true 3.00.")
