"""
Pile-up against the Poisson model
=================================

A pixel with a dead time of 75 ns receives light from a bright surface at a delay of 40 ns. A model without dead time
(Poisson) predicts the grey histogram; the pixel registers far fewer photons, too many of them early, and a shadow
follows the pulse. The exact mean, computed without simulation, agrees with the simulated counts. The program prints
``45% of the photons are registered.``

Theory: :doc:`/theory_exposure`.
"""

import matplotlib.pyplot as plt

import mars_lidar as ml

pulse, detector = ml.GaussianPulse(sigma_ns=1.0), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=1e3 / 7.5, cycles=200_000, bins=256, pulse=pulse, detector=detector)
flux = ml.Flux(signal=1.0, background=1.0, delay_ns=40.0)  # photons per laser period
counts = ml.simulate(flux, system, seed=0)[0, 0, 0]
mean = ml.mean_histogram(flux, system)
poisson = ml.simulate(flux, system, engine="poisson", seed=0)[0, 0, 0]

fig, ax = plt.subplots()
ax.fill_between(system.time_ns, poisson, step="mid", color="0.85", label=f"Poisson model, {poisson.sum():,} counts")
ax.plot(system.time_ns, counts, ".", ms=3, label=f"simulated with dead time, {counts.sum():,} counts")
ax.plot(system.time_ns, mean, label="exact mean histogram")
ax.set(xlabel="time in the laser period (ns)", ylabel="counts per bin", yscale="log")
ax.legend()
plt.show()
print(f"{counts.sum() / poisson.sum():.0%} of the photons are registered.")
