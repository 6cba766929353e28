r"""
1 What a single-photon detector does
====================================

A LiDAR sends a short pulse of light, waits for the echo, and turns the delay :math:`\tau` of the echo into a
distance,

.. math:: z = \tfrac12 c \tau, \qquad \text{1 ns of delay is 15 cm.}

A distant or dark surface returns less than a photon per pulse. A *single-photon avalanche diode* (SPAD) registers
such light: one photon triggers an avalanche of charge, and a clock records its time. The avalanche must then be
quenched and the diode recharged. During this *dead time* :math:`t_d`, some 20 to 100 ns, the detector registers
nothing. The dead time is longer than the pulse and often a large part of the laser period; it causes the effects that
these lessons describe.

The laser repeats the pulse thousands of times with a period :math:`t_r`, and the times since the last pulse are
sorted into the bins of a *histogram*. Light is measured in photons per period: :math:`S` *signal* photons from the
pulse, :math:`B` *background* photons from the sun or lamps, which arrive at any time. Both are expected numbers:
photons arrive at random (an inhomogeneous Poisson process).

Arriving and registered photons
-------------------------------

The detector in a few lines: draw the arrivals of some periods, and register each arrival that is at least a dead time
later than the previous registration. Arrivals during the dead time have no effect.
"""

import matplotlib.pyplot as plt
import numpy as np

import mars_lidar as ml

period_ns, dead_time_ns, delay_ns = 100.0, 75.0, 60.0
random = np.random.default_rng(3)


def arrivals(signal: float, background: float, periods: int) -> np.ndarray:
    """Times of all photons, ns."""
    pulses = np.repeat(np.arange(periods), random.poisson(signal, periods))
    echoes = period_ns * pulses + random.normal(delay_ns, 2.0, pulses.size)
    return np.sort(np.append(echoes, random.uniform(0, period_ns * periods, random.poisson(background * periods))))


def registered(times: np.ndarray) -> np.ndarray:
    """Those of the times at which the detector is armed."""
    accepted, armed_from = [], -np.inf
    for time in times:
        if time >= armed_from:
            accepted.append(time)
            armed_from = time + dead_time_ns
    return np.array(accepted)


photons = arrivals(1.5, 1.5, 6)
clicks = registered(photons)

fig, ax = plt.subplots(figsize=(7.2, 2.2))
for k in range(7):
    ax.axvline(k * period_ns, color="0.8", lw=1)
for click in clicks:
    ax.axvspan(click, click + dead_time_ns, ymax=0.45, color="C1", alpha=0.2, lw=0)
ax.eventplot([photons, clicks], lineoffsets=[1.6, 0.5], linelengths=0.7, colors=["0.4", "C1"])
ax.set(xlim=(0, 600), ylim=(0, 2.2), yticks=[0.5, 1.6], yticklabels=["registered", "photons"], xlabel="time (ns)")
ax.set_title("Six laser periods (grey lines); the dead time after each registration is shaded")
plt.show()

# %%
# Why more light can give a worse depth
# -------------------------------------
#
# The pulse has a width, here a standard deviation of 2 ns. If many photons arrive with each pulse, the *first* of
# them lies on the leading edge of the pulse. It starts the dead time, and the photons of the centre of the pulse are
# never registered. The peak of the histogram therefore moves to earlier times as the light grows: for
# :math:`S = 0.2` it coincides with the light, for :math:`S = 20` it is early, although a hundred times more photons
# arrive. ``ml.simulate`` draws such histograms without drawing the lost photons:

pulse, detector = ml.GaussianPulse(sigma_ns=2.0), ml.Detector(dead_time_ns=dead_time_ns)
system = ml.System(period_ns=period_ns, cycles=2000, bins=128, pulse=pulse, detector=detector)

fig, axes = plt.subplots(1, 2, sharex=True)
for ax, signal in zip(axes, (0.2, 20.0), strict=True):
    counts = ml.simulate(ml.Flux(signal, 0.1, delay_ns), system, seed=1)[0, 0, 0]
    light = system.cycles * ml.statistics.photons_per_bin(ml.Flux(signal, 0.1, delay_ns), system, bins=128)
    ax.fill_between(system.time_ns, light / light.max(), color="0.85", step="mid", label="light, scaled")
    ax.step(system.time_ns, counts / counts.max(), where="mid", label="counts, scaled")
    ax.axvline(delay_ns, color="k", lw=0.8, ls=":")
    ax.set(xlim=(48, 72), xlabel="time in the period (ns)")
    ax.set_title(f"S = {signal:g}: {light.sum():,.0f} photons, {counts.sum():,} counts")
axes[0].legend(loc="upper left")
plt.show()

# %%
# This error is a bias, not noise: more pulses do not remove it. The depth of the fullest bin of the *exact mean*
# histogram (``mean_histogram``, no simulation), compared with the truth over a range of light:

signals = np.geomspace(0.05, 100, 40)
fine = system.replace(bins=1024)
means = [ml.mean_histogram(ml.Flux(signal, 0.1, delay_ns), fine) for signal in signals]
early_ns = np.array([delay_ns - fine.time_ns[mean.argmax()] for mean in means])

fig, ax = plt.subplots()
ax.plot(signals, 14.99 * early_ns)
ax.axhline(0, color="0.7", lw=0.8)
ax.set(xscale="log", xlabel="signal S (photons per period)", ylabel="depth too short by (cm)")
ax.set_title("The depth of the fullest bin, without any noise")
plt.show()
at_20 = 14.99 * np.interp(20.0, signals, early_ns)
print(f"At S = 20 the fullest bin is {at_20:.0f} cm too short.")

# %%
# The last line printed is ``At S = 20 the fullest bin is 52 cm too short.``
#
# Next: :doc:`lesson_2_pile_up` derives the shape of the histogram. Theory: :doc:`/theory_detectors`, the law of each
# mode of detector. How-to: :doc:`/start` simulates a scene, :doc:`/detectors` describes your own detector.
