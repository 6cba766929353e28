"""
Four modes of a detector in the same light
==========================================

The same light on four pixels: free-running, where photons in the dead time are lost; paralyzable, where they
prolong it; synchronous, which registers the first photon of each laser period; gated, which registers nothing outside
of its gate. Dots are simulated, lines are the exact mean. The program prints ``The paralyzable pixel registers 82% of
the free-running one's photons.``

Theory: :doc:`/theory_detectors`. How-to: :doc:`/detectors`.
"""

import matplotlib.pyplot as plt

import mars_lidar as ml

pulse, flux = ml.GaussianPulse(sigma_ns=1.0), ml.Flux(signal=1.0, background=2.0, delay_ns=60.0)
modes = {
    "nonparalyzable": {},
    "paralyzable": {},
    "synchronous": {},
    "gated": {"gate_start_ns": 50, "gate_width_ns": 30},
}
counted = {}
fig, axes = plt.subplots(2, 2, figsize=(7.2, 4.4), sharex=True, sharey=True)
for ax, (mode, gate) in zip(axes.flat, modes.items(), strict=True):
    detector = ml.Detector(dead_time_ns=30.0, mode=mode, **gate)
    system = ml.System(period_ns=100.0, cycles=50_000, bins=200, pulse=pulse, detector=detector)
    counts = ml.simulate(flux, system, seed=0)[0, 0, 0]
    counted[mode] = counts.sum()
    ax.plot(system.time_ns, counts, ".", ms=2)
    ax.plot(system.time_ns, ml.mean_histogram(flux, system), lw=1)
    ax.set(title=f"{mode}: {counts.sum():,} counts", ylim=(-0.3, 10_000))
    ax.set_yscale("symlog", linthresh=1.0)  # zeros have a place
fig.supxlabel("time in the laser period (ns)", fontsize=9)
fig.supylabel("counts per bin", fontsize=9)
plt.show()
share = counted["paralyzable"] / counted["nonparalyzable"]
print(f"The paralyzable pixel registers {share:.0%} of the free-running one's photons.")
