r"""
3 What dead time does to counts, shapes and correlations
========================================================

A free-running detector is armed again as soon as its dead time :math:`t_d` is over, at any phase of the laser period.
Its histogram differs from a Poisson histogram in three ways.

Counts: fewer, and more regular
-------------------------------

Under constant light of rate :math:`\lambda`, successive registrations are a dead time and a wait of mean
:math:`1/\lambda` apart. Renewal theory gives for the count :math:`N` of a long exposure :math:`t`

.. math:: \mathsf E N = \frac{\lambda t}{1 + \lambda t_d},
   \qquad \frac{\operatorname{Var} N}{\mathsf E N} = \frac{1}{(1 + \lambda t_d)^2}. \tag{1}

For a Poisson count the ratio is 1. Under pulsed light it can be orders of magnitude smaller: the registrations *lock*
to the laser pulses (mode locking). The figure shows the exact law of the count, ``ml.count_law``, for pulsed and for
constant light of the same mean:
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml
from mars_lidar.statistics import mean_histogram, photons_per_bin

pulse, detector = ml.GaussianPulse(sigma_ns=1.0), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=100.0, cycles=1000, bins=100, pulse=pulse, detector=detector)

fig, ax = plt.subplots()
for signal, background, name in ((0.0, 3.0, "constant light"), (2.9, 0.1, "pulses")):
    law = ml.count_law(ml.Flux(signal, background, 40.0), system)
    ax.plot(law.support, law.pmf, label=f"{name}: variance / mean {law.variance / law.mean:.3f}")
mean = float(ml.count_law(ml.Flux(0.0, 3.0), system).mean)
n = np.arange(820, 1040)
ax.plot(
    n,
    np.exp(-((n - mean) ** 2) / (2 * mean)) / np.sqrt(2 * np.pi * mean),
    "k--",
    lw=1,
    label="Poisson of the same mean",
)
ax.set(xlabel="counts in 1000 periods, 3 photons per period", ylabel="probability", xlim=(820, 1040))
ax.legend()
plt.show()

# %%
# Shapes: shadows and echoes
# --------------------------
#
# A bright return is registered in nearly every period, so that in nearly every period the detector is dead for the
# following :math:`t_d`, and re-arms at the same phase. The return casts a *shadow* of length :math:`t_d`, and at its
# end the counts rise above the level of the background: a false echo. The figure shows the probability of being armed,
# which is the histogram divided by the light:

fig, ax = plt.subplots()
short = system.replace(detector=ml.Detector(dead_time_ns=40.0))
for signal in (0.1, 1.0, 8.0):
    shape = mean_histogram(ml.Flux(signal, 3.0, 30.0), short)
    ax.plot(
        short.time_ns,
        shape / (short.cycles * photons_per_bin(ml.Flux(signal, 3.0, 30.0), short, bins=100)),
        label=f"S = {signal:g}",
    )
ax.axvline(30, color="0.7", lw=0.8)
ax.axvline(70, color="0.7", lw=0.8, ls="--")
ax.set(xlabel="time (ns): return at 30, dead time of 40 ends at 70", ylabel="counts over light")
ax.legend()
plt.show()

# %%
# Correlations: bins are not independent
# --------------------------------------
#
# One registration excludes all others for a dead time. The bins of the return compete with each other, and with the
# background, for one registration per period: what one bin gains, others lose (blue). Two registrations often follow
# each other after the dead time of 75 ns and before the next return, so that background bins 75 to 100 ns apart, which
# in the period is also 0 to 25 ns apart, gain together (red). ``ml.joint_law`` gives the exact covariance of all bins
# of a finite exposure:

joint = ml.joint_law(ml.Flux(5.0, 0.5, 40.0), system)
covariance = joint.covariance()
spread = np.sqrt(np.diag(covariance))
correlation = covariance / np.outer(spread, spread)
np.fill_diagonal(correlation, np.nan)

fig, ax = plt.subplots(figsize=(4.6, 3.8))
image = ax.imshow(correlation, cmap="RdBu_r", vmin=-0.05, vmax=0.05, origin="lower", extent=(0, 100, 0, 100))
fig.colorbar(image, label="correlation of two bins", extend="min")
ax.set(xlabel="time of one bin (ns)", ylabel="time of the other (ns)")
ax.set_title(f"S = 5, B = 0.5, return at 40 ns; least {np.nanmin(correlation):.2f}")
plt.show()
near = slice(35, 45)
window = covariance[near, near].sum() / np.trace(covariance[near, near])
print(f"Counts of the ten bins around the return: their sum has {window:.2f} of the variance of independent bins.")

# %%
# The last line printed is
# ``Counts of the ten bins around the return: their sum has 0.19 of the variance of independent bins.``
# An error bar from the sum of the bins' variances is too long by the inverse square root of that number.
#
# Next: :doc:`lesson_4_depth`. Theory: :doc:`/theory_exposure` (counts and shapes), :doc:`/joint_law` (correlations),
# :doc:`/theory` (the Markov-renewal view of the MaRS paper). How-to: :doc:`/engines` says which engine draws these
# correlations.
