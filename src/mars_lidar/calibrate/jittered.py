"""The light of a jittered detector as its records show it, exactly.

An avalanche at T is recorded at X = T + J. From an instant w on at which the pixel is armed for certain and has long
been, T has the density lambda(t) e^-Lambda(t) up to a factor, with Lambda(t) the integral of lambda. So X has the
density (lambda e^-Lambda) * f, f that of J, and P(X > x) is (e^-Lambda) * f up to the same factor. Their ratio

    lambda'(x) = [(lambda e^-Lambda) * f](x) / [e^-Lambda * f](x)                                              (1)

is the rate of records, given all records before. It repeats with the laser, because both convolutions fall by
e^-Lambda(t_r) from one period to the next, and its integral over a period is that of lambda. A jittered pixel that is
watched only from its dead time and some widths of the jitter on is thus exactly a pixel without jitter in the
light lambda', whose likelihood is known. Where little light falls within a width of the jitter lambda' is
lambda * f; of a bright pulse it is later and narrower, because the first photons shut the pixel.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import SampledPulse

REACH = 8.5  # widths of a Gaussian that are taken along: less than 1e-16 lie outside
_NOTHING = 1e-19  # of a kernel's largest bin
_LUCY = 1000  # steps of Richardson and Lucy for a pulse, which was measured with many photons
_BRIGHT = 20.0  # photons per period above which rounding of a Fourier transform would show behind the pulse


def normal_kernel(sigma_ns: float, period_ns: float, bins: int) -> FloatArray:
    """Mass (bins,) of a Gaussian in cells about 0, 1, ..., -1 bins of the period."""
    from scipy.special import ndtr

    step = period_ns / bins / sigma_ns
    place = (np.arange(bins) + bins // 2) % bins - bins // 2
    mass = ndtr((place + 0.5) * step) - ndtr((place - 0.5) * step)
    return np.asarray(mass / mass.sum())


class Records:
    """`lambda'` of (1) in bins of the period, and its derivatives, for light `rate` (n,) and a `kernel` (n,) of J."""

    def __init__(self, rate: FloatArray, kernel: FloatArray) -> None:
        self._n = rate.size
        self._total = float(rate.sum())
        self._k = np.arange(self._n)
        # e^-Lambda at the edges of bins is e^(-total k / n) times a factor that repeats; the kernel takes the rest
        before = np.concatenate([[0.0], np.cumsum(rate)[:-1]])
        alive = self._total * self._k / self._n - before
        self._alive = np.exp(alive - alive.max())  # up to a factor, which falls out
        used = np.flatnonzero(kernel > 0.0)
        place = (used + self._n // 2) % self._n - self._n // 2
        # a pixel is no more alive later: of what is recorded too early less than 1e-17 matters nowhere
        seen = (place >= 0) | (kernel[used] > _NOTHING * float(kernel.max()))
        self._low, self._high = int(place[seen].min()), int(place[seen].max())
        self._place = np.arange(self._low, self._high + 1)  # of the kernel's bins
        tilt = np.exp(np.clip(self._total * self._place / self._n, -700.0, 700.0))
        self._kernel = np.maximum(kernel[self._place % self._n], 0.0) * tilt
        self._blurred = self._convolved(self._alive, self._kernel)
        below = -np.log(np.maximum(self._blurred, 1e-300))
        self.rate = np.maximum(np.append(below[1:], below[0]) - below + self._total / self._n, 1e-300)

    def slope(self, change: FloatArray) -> FloatArray:
        """Derivative (n,) of `rate` where the light changes by `change` (n,)."""
        grown = float(change.sum())
        before = np.concatenate([[0.0], np.cumsum(change)[:-1]]) - grown * self._k / self._n
        blurred = self._convolved(self._alive * before, self._kernel)
        if grown:
            blurred = blurred - grown * self._moment
        part = blurred / np.maximum(self._blurred, 1e-300)
        return np.asarray(np.append(part[1:], part[0]) - part + grown / self._n)

    @cached_property
    def _moment(self) -> FloatArray:
        """What a change of all light alike, from the phase of the bin on, adds."""
        return self._convolved(self._alive, self._kernel * self._place / self._n)

    def _convolved(self, values: FloatArray, kernel: FloatArray) -> FloatArray:
        """Values (n,) of the period, blurred by a kernel at `_place`."""
        from scipy.signal import convolve

        around = values[np.arange(-self._high, self._n - self._low) % self._n]
        return np.asarray(convolve(around, kernel, "valid", "direct" if self._total >= _BRIGHT else "fft"))


def split_sigma(recorded_ns: float, jitter_ns: float) -> tuple[float, float]:
    """Sigma of the pulse and of the jitter behind a recorded Gaussian, ns, where the jitter is known only roughly.

    The recorded width is what the data tell best. A jitter estimated above it is taken down to 0.995 of it.
    """
    jitter = min(jitter_ns, math.sqrt(0.99) * recorded_ns)
    return math.sqrt(recorded_ns**2 - jitter**2), jitter


def unblurred(values: FloatArray, kernel: FloatArray, steps: int = 100) -> FloatArray:
    """Values (n,) >= 0 of the period as they were before a `kernel` (n,) blurred them.

    Richardson (1972) and Lucy (1974): non-negative, of the same sum, stopped after some `steps`, before noise is made
    into peaks.
    """
    gain = np.fft.rfft(kernel)
    sharp = values
    for _ in range(steps):
        seen = np.fft.irfft(np.fft.rfft(sharp) * gain, values.size)
        share = np.where(seen > 0.0, values / np.maximum(seen, 1e-300), 1.0)
        sharp = np.maximum(sharp * np.fft.irfft(np.fft.rfft(share) * np.conj(gain), values.size), 0.0)
    return np.asarray(sharp * (float(values.sum()) / max(float(sharp.sum()), 1e-300)))


@lru_cache(maxsize=16)
def before_blur(recorded: SampledPulse, jitter_ns: float) -> tuple[SampledPulse, float]:
    """A measured pulse without the jitter that it holds, about its centroid; and where that is in the recorded one, ns.

    The centroid stays where it is under a jitter of mean 0.
    """
    size, low = recorded.values.size, recorded.support_ns()[0]
    mass = np.diff(recorded.cumulative(low + recorded.bin_ns * np.arange(size + 1)))
    sharp = unblurred(mass, normal_kernel(jitter_ns, size * recorded.bin_ns, size), _LUCY)
    turn = np.exp(2j * np.pi * (np.arange(size) + 0.5) / size) @ sharp
    centre = float(np.angle(turn)) / (2.0 * np.pi) * size % size
    return SampledPulse(sharp, recorded.bin_ns, "centroid"), low + centre * recorded.bin_ns


def after_blur(pulse: SampledPulse, jitter_ns: float) -> SampledPulse:
    """A pulse about its centroid as a jitter records it, about its centroid too.

    Records of another length would have another (circular) centroid: ValueError where the jitter needs more room.
    """
    size, low = pulse.values.size, pulse.support_ns()[0]
    kernel = normal_kernel(jitter_ns, size * pulse.bin_ns, size)
    mass = np.diff(pulse.cumulative(low + pulse.bin_ns * np.arange(size + 1)))
    bright = np.flatnonzero(mass > 1e-3 * mass.max())
    room = size - int(bright[-1] - bright[0])
    if room * pulse.bin_ns < 6.0 * jitter_ns:
        raise ValueError(
            f"values of a measured pulse must leave 6 sigma of a jitter of {jitter_ns:.4g} ns without light, got "
            f"{room * pulse.bin_ns:.4g} ns: add zeros at its end"
        )
    blurred = np.fft.irfft(np.fft.rfft(mass) * np.fft.rfft(kernel), size)
    return SampledPulse(np.maximum(blurred, 0.0), pulse.bin_ns, "centroid")
