"""Limits of the light of an image, and of how finely its waveforms are computed."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Constants of the light that are not arguments.

    Attributes
    ----------
    delay_ns
        Largest delay, a second: beyond it double precision does not give the phase in a period to 1e-6 ns.
    photons
        Most photons of a pixel and period; the samplers are tested to 1e3.
    returns
        Most returns of a pixel, and layers of a scene.
    band_bytes, work_bytes
        Waveforms computed together, and those folded and convolved together, which takes about six times as much.
    parts, parts_per_bin
        Most parts of the period in a waveform, and the parts of a histogram bin in fog.
    periods
        Most laser periods that light may last: each is folded on its own.
    delays
        Midpoints inside a part for the pulse's average: error below (part / pulse width)^2 / 1e5.
    fog_depths
        Optical depths of the way there and back beyond which nothing returns: e^-40.
    fog_periods
        Periods from which light of fog is spread evenly.
    """

    delay_ns: float = 1e9
    photons: float = 1e6
    returns: int = 16
    band_bytes: int = 64 * 2**20
    work_bytes: int = 8 * 2**20
    parts: int = 2**20
    parts_per_bin: int = 4
    periods: int = 2**12
    delays: int = 64
    fog_depths: float = 40.0
    fog_periods: int = 256


TOL = Tolerances()
