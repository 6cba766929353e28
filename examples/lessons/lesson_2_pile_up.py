r"""
2 Pile-up
=========

*Pile-up* is the distortion of a histogram by registrations of early photons, which prevent those of later ones. It is
simplest for a detector that starts every period armed and registers only the first photon (mode ``"synchronous"``,
classical time-correlated single-photon counting, TCSPC).

Let :math:`l_j` be the expected photons in bin :math:`j` of one period and :math:`F_j = \sum_{k<j} l_k` those before
it. With probability :math:`\mathrm e^{-F_j}` no photon of the Poisson process arrives before bin :math:`j`, and with
:math:`1 - \mathrm e^{-l_j}` at least one arrives in it, so that

.. math:: P(\text{registered in bin } j) = \mathrm e^{-F_j}\,\bigl(1 - \mathrm e^{-l_j}\bigr). \tag{1}

The factor :math:`\mathrm e^{-F_j}` is the pile-up: all the light before a bin attenuates its counts. A uniform
background becomes a decaying exponential, and a pulse is skewed towards early times.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml
from mars_lidar.reconstruction import Coates

pulse = ml.GaussianPulse(sigma_ns=2.0)
detector = ml.Detector(dead_time_ns=0.0, mode="synchronous")
system = ml.System(period_ns=100.0, cycles=20_000, bins=128, pulse=pulse, detector=detector)

fig, axes = plt.subplots(1, 3, sharey=True)
for ax, scale in zip(axes, (0.05, 0.5, 5.0), strict=True):
    light = ml.statistics.photons_per_bin(ml.Flux(scale, scale, 60.0), system, bins=128)
    before = np.append(0.0, np.cumsum(light)[:-1])
    expected = np.exp(-before) * -np.expm1(-light)  # equation (1)
    counts = ml.simulate(ml.Flux(scale, scale, 60.0), system, seed=2)[0, 0, 0]
    ax.fill_between(system.time_ns, light / scale, step="mid", color="0.85", label="light")
    ax.plot(system.time_ns, counts / system.cycles / scale, ".", ms=3, label="counts")
    ax.plot(system.time_ns, expected / scale, label="equation (1)")
    ax.set_yscale("symlog", linthresh=1e-5)  # bins without counts at 0
    ax.set(ylim=(0, 3), xlabel="time (ns)")
    ax.set_title(f"S = B = {scale:g}")
axes[0].set_ylabel("per bin and period, over S")
axes[0].legend(loc="upper left")
plt.show()

# %%
# At a twentieth of a photon per period (left) counts and light agree; hence the laboratory rule to register photons
# from at most 5 % of the pulses. That rule wastes 95 % of the pulses, and since (1) can be inverted it is not needed.
#
# Correcting pile-up
# ------------------
#
# Of :math:`N_r` periods, those that registered before bin :math:`j` were dead in it; the others were armed. With
# :math:`n_j` counts,
#
# .. math:: \text{armed}_j = N_r - \sum_{k<j} n_k,
#    \qquad \hat l_j = -\ln\Bigl(1 - \frac{n_j}{\text{armed}_j}\Bigr). \tag{2}
#
# This is Coates' estimator (1968), the maximum likelihood for this detector. It is noisy where few periods are still
# armed.

counts = ml.simulate(ml.Flux(2.0, 2.0, 60.0), system, seed=3)[0, 0, 0].astype(float)
light = ml.statistics.photons_per_bin(ml.Flux(2.0, 2.0, 60.0), system, bins=128)
armed = system.cycles - np.append(0, np.cumsum(counts)[:-1])
estimate = -np.log1p(-counts / armed)  # equation (2)
assert np.allclose(estimate, Coates().rates(counts, system))

fig, ax = plt.subplots()
ax.fill_between(system.time_ns, light, step="mid", color="0.85", label="light")
ax.step(system.time_ns, counts / system.cycles, where="mid", label="counts per period")
ax.plot(system.time_ns, estimate, ".", label="equation (2)")
ax.set_yscale("symlog", linthresh=1 / system.cycles)
ax.set(ylim=(0, 0.5), xlabel="time in the period (ns)", ylabel="photons per bin and period")
ax.legend(loc="upper left")
plt.show()
sums = [values[40:90].sum() for values in (counts / system.cycles, estimate, light)]
lost, error = 1 - sums[0] / sums[2], sums[1] / sums[2] - 1
print(f"Photons between 31 and 70 ns: the counts lose {lost:.0%}, the correction is off by {error:+.1%}.")

# %%
# The last line printed is
# ``Photons between 31 and 70 ns: the counts lose 82%, the correction is off by -1.8%.``
#
# A *free-running* detector is not armed by the laser: its dead time extends from one period into the next, and
# equations (1) and (2) do not hold. Next: :doc:`lesson_3_dead_time`. Theory: :doc:`/theory_detectors` (this mode).
# How-to: :doc:`/reconstruction`.
