"""Limits of the values that describe an instrument, and accuracies of its pulses."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Constants of the instrument that are not arguments.

    Attributes
    ----------
    generations, samples
        Generations of afterpulses that a number may ask for; samples of a pulse or of a density of delays (128 MiB).
    delay_periods
        Laser periods of a mean delay of afterpulses or of a recovery: beyond it a pixel at rest and one that is not can
        no longer be distinguished in double precision.
    gate_ns, gate_periods
        Start or step of a gate, which is taken modulo the period: far beyond it no digits are left; least width in
        periods: phases have 24 bits, and at 1e-6 periods the counts behind a gate were 4 % off.
    cycles, recorded_cycles
        Laser periods of a simulation, which the samplers count in 32 bits (ten seconds at 10 MHz), or of the steps of a
        gate; of a recording, the integers that doubles hold.
    bins, dead_periods
        Most bins of a histogram (8 MiB an array), and most laser periods of a dead time.
    rate_hz
        Dark counts or photons per second.
    events
        Records of an exposure: 32-bit counters.
    codes
        Codes of a TDC.
    curve_points
        Points of a curve in a notebook, more than its pixels.
    jitter_periods
        Widest sigma of a Gaussian jitter, in periods: 8.5 of it lie within half a period.
    gaussian_sigmas
        Half support of a Gaussian pulse in sigma: what lies outside, 1e-17, is below one photon in any exposure.
    train_periods
        Sigma in periods from which a train of pulses is summed as a Fourier series.
    times_together
        Times at which a pulse is evaluated together: they stay in the first cache.
    exponent
        -log of what is rounding: e^-40.
    lined_bytes
        Size of a JSON file up to which it is read as YAML, a hundred times slower, so that errors state the line.
    seconds_as_ns
        ns below which a time is one in seconds that was taken for ns: a second is the longest of any instrument.
    unusual_periods
        Periods from which a median delay is unusual.
    typed_digits
        Significant digits of typed values; computed values have more.
    """

    generations: int = 1_000_000
    samples: int = 2**24
    delay_periods: float = 1e6
    gate_ns: float = 1e12
    gate_periods: float = 1e-5
    cycles: int = 100_000_000
    recorded_cycles: int = 2**53
    bins: int = 2**20
    dead_periods: int = 2**20
    rate_hz: float = 1e12
    events: int = 2**31 - 1
    codes: int = 2**16
    curve_points: int = 300
    jitter_periods: float = 0.05
    gaussian_sigmas: float = 8.5
    train_periods: float = 0.3
    times_together: int = 1 << 15
    exponent: float = 40.0
    lined_bytes: int = 2**16
    seconds_as_ns: float = 1e-6
    unusual_periods: float = 100.0
    typed_digits: int = 3


TOL = Tolerances()
