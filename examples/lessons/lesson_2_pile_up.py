r"""
2 Pile-up
=========

*Pile-up* is the bending of a histogram because earlier photons hide later ones. It is simplest where the detector
starts every period armed and registers its first photon only (mode ``"synchronous"``, the classical time-correlated
photon counting).

Let :math:`l_j` be the expected photons in bin :math:`j` of one period and :math:`F_j = \sum_{k<j} l_k` those before
it. No photon of a Poisson process comes before bin :math:`j` with probability :math:`\mathrm e^{-F_j}`, and at least
one in it with :math:`1 - \mathrm e^{-l_j}`, so that

.. math:: P(\text{registered in bin } j) = \mathrm e^{-F_j}\,\bigl(1 - \mathrm e^{-l_j}\bigr). \tag{1}

The factor :math:`\mathrm e^{-F_j}` is the pile-up: each bin is seen through a filter that all the light before it has
darkened. A uniform background becomes a falling exponential, and a pulse leans to the left.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml
from mars_lidar.reconstruct import coates_rates

pulse = ml.GaussianPulse(sigma_ns=2.0)
detector = ml.Detector(dead_time_ns=0.0, mode="synchronous")
system = ml.System(period_ns=100.0, cycles=20_000, bins=128, pulse=pulse, detector=detector)

fig, axes = plt.subplots(1, 3, sharey=True)
for ax, scale in zip(axes, (0.05, 0.5, 5.0), strict=True):
    light = ml.statistics.photons_per_bin(ml.Flux(scale, scale, 60.0), system, bins=128)
    before = np.append(0.0, np.cumsum(light)[:-1])
    seen = np.exp(-before) * -np.expm1(-light)  # equation (1)
    counts = ml.simulate(ml.Flux(scale, scale, 60.0), system, seed=2)[0, 0, 0]
    ax.fill_between(system.time_ns, light / scale, step="mid", color="0.85", label="light")
    ax.plot(system.time_ns, counts / system.cycles / scale, ".", ms=3, label="counts")
    ax.plot(system.time_ns, seen / scale, label="equation (1)")
    ax.set(yscale="log", ylim=(1e-5, 0.3), xlabel="time (ns)")
    ax.set_title(f"S = B = {scale:g}")
axes[0].set_ylabel("per bin and period, over S")
axes[0].legend(loc="upper left")
plt.show()

# %%
# With a twentieth of a photon per period (left) counts and light agree, which is why laboratories keep to "5 % of the
# pulses". That rule throws 95 % of the pulses away. Equation (1) needs no such rule, since it can be inverted.
#
# Undoing it
# ----------
#
# Of :math:`N_r` periods, those that registered before bin :math:`j` were blind in it; the others were armed. With
# :math:`n_j` counts,
#
# .. math:: \text{armed}_j = N_r - \sum_{k<j} n_k,
#    \qquad \hat l_j = -\ln\Bigl(1 - \frac{n_j}{\text{armed}_j}\Bigr). \tag{2}
#
# This is Coates' estimator (1968): count in how many periods the bin had a chance at all. It is exact for this
# detector, and noisy where few periods are still armed.

counts = ml.simulate(ml.Flux(2.0, 2.0, 60.0), system, seed=3)[0, 0, 0].astype(float)
light = ml.statistics.photons_per_bin(ml.Flux(2.0, 2.0, 60.0), system, bins=128)
armed = system.cycles - np.append(0, np.cumsum(counts)[:-1])
estimate = -np.log1p(-counts / armed)  # equation (2)
assert np.allclose(estimate, coates_rates(counts, system))

fig, ax = plt.subplots()
ax.fill_between(system.time_ns, light, step="mid", color="0.85", label="light")
ax.step(system.time_ns, counts / system.cycles, where="mid", label="counts per period")
ax.plot(system.time_ns, estimate, ".", label="equation (2)")
ax.set(yscale="log", ylim=(1e-4, 0.5), xlabel="time in the period (ns)", ylabel="photons per bin and period")
ax.legend(loc="upper left")
plt.show()
sums = [values[40:90].sum() for values in (counts / system.cycles, estimate, light)]
lost, error = 1 - sums[0] / sums[2], sums[1] / sums[2] - 1
print(f"Photons between 31 and 70 ns: the counts lose {lost:.0%}, the correction is off by {error:+.1%}.")

# %%
# The last line printed is
# ``Photons between 31 and 70 ns: the counts lose 82%, the correction is off by -1.8%.``
#
# A *free-running* detector is not armed by the laser: its dead time reaches over from one period to the next, and
# both formulas fail. What replaces them is in :doc:`lesson_3_dead_time`. Theory: :doc:`/theory_exposure`. How-to:
# :doc:`/reconstruction`.
