r"""
5 How sure can one be?
======================

An estimate needs a standard error, and a bound shows whether a better estimator could exist.

**The standard error** of an estimate follows from the curvature of the log-likelihood: with :math:`\theta = (S, B,
\tau)`

.. math:: \operatorname{Cov} \hat\theta \approx \Bigl[-\frac{\partial^2 \log L}
   {\partial \theta\, \partial \theta'}\Bigr]^{-1}. \tag{1}

**The Cramér-Rao bound** is the least standard error of any unbiased estimator under the true light:

.. math:: \operatorname{Cov} \hat\theta \ge I(\theta)^{-1}, \qquad I_{ab} = \sum_j \mathsf E[\text{armed}_j]\,
   \frac{\mathrm e^{-l_j}}{1 - \mathrm e^{-l_j}}\,
   \frac{\partial l_j}{\partial \theta_a}\, \frac{\partial l_j}{\partial \theta_b}. \tag{2}

Dead time enters through the expected armed periods alone. More light leaves fewer armed periods, so that the bound
itself stops decreasing; the error of an estimator that ignores dead time increases.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml

pulse, detector = ml.GaussianPulse(sigma_ns=2.0), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=100.0, cycles=2000, bins=128, pulse=pulse, detector=detector)
signal = np.geomspace(0.03, 30, 13)
repeats = 400
delay_ns = np.random.default_rng(6).uniform(30, 70, (repeats, signal.size))
flux = ml.Flux(np.broadcast_to(signal, delay_ns.shape), np.full(delay_ns.shape, 0.5), delay_ns)
cube = ml.simulate(flux, system, seed=6)[0]

fig, ax = plt.subplots()
for method in ("peak", "maximum_likelihood"):
    error_cm = 14.99 * (ml.reconstruct(cube, system, method).delay_ns - delay_ns)
    rms = np.sqrt(np.nanmean(error_cm**2, axis=0))
    scatter = np.nanstd(error_cm**2, axis=0) / (2 * rms * np.sqrt(repeats))  # standard error of the rms
    ax.errorbar(signal, rms, scatter, fmt="o-", ms=3, label=method.replace("_", " "))
bound = 100 * ml.cramer_rao(ml.Flux(signal, 0.5, 50.0), system).depth_m
ax.plot(signal, bound, "k--", label="Cramér-Rao bound")
ax.set(xscale="log", yscale="log", xlabel="signal S (photons per period), B = 0.5", ylabel="depth error, rms (cm)")
ax.legend()
plt.show()

# %%
# Coverage of the error bars
# --------------------------
#
# If the standard errors are right, the error divided by its standard error is a standard normal number: 68 % within
# one, 95 % within two. The figure tests this on the 400 exposures of each signal. Every method should pass this test,
# a network included (:doc:`/downstream`).

estimate = ml.reconstruct(cube, system)
pull = (estimate.delay_ns - delay_ns) / estimate.delay_error_ns

fig, ax = plt.subplots()
for within, color in ((1, "C0"), (2, "C1")):
    share = np.nanmean(np.abs(pull) < within, axis=0)
    ax.errorbar(
        signal,
        share,
        np.sqrt(share * (1 - share) / repeats),
        fmt="o",
        ms=3,
        color=color,
        label=f"within {within} standard error{'s' * (within > 1)}",
    )
    ax.axhline({1: 0.6827, 2: 0.9545}[within], color=color, lw=0.8)
ax.set(xscale="log", ylim=(0, 1.02), xlabel="signal S (photons per period)", ylabel="share of exposures")
ax.legend(loc="lower right")
plt.show()
once, twice = (np.nanmean(np.abs(pull) < within) for within in (1, 2))
print(f"{once:.0%} of all depths are within one standard error, {twice:.0%} within two.")

# %%
# The last line printed is ``68% of all depths are within one standard error, 95% within two.``
#
# This was the last lesson. Theory: :doc:`/theory_reconstruction` derives the bound and the errors. How-to:
# :doc:`/reconstruction` gives both for your own histogram. Next: :doc:`/howto` for recipes,
# :doc:`/gallery/index` for further examples, :doc:`/explanation` for the derivations.
