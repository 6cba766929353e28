"""A detector with effects, as a stream shows it: what of it is in the light, in the pulse, in the intervals."""

from __future__ import annotations

import math

from mars_lidar.calibrate.jittered import after_blur
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.effects import TIMING_EFFECTS, Jitter
from mars_lidar.instrument.pulse import GaussianPulse, Pulse, SampledPulse
from mars_lidar.instrument.system import System

_UNKNOWN = {
    "crosstalk": "neighbouring pixels, which one stream does not tell",
    "max_events_per_exposure": "exposures, which a running stream does not have",
}
_IN_THE_LIGHT = ("detection_efficiency", "dark_count_hz")


def stream_detector(detector: Detector) -> Detector:
    """The detector as calibrated light sees it: efficiency and dark counts are in S and B already.

    Raises ValueError for one whose streams cannot be calibrated or predicted.
    """
    if not isinstance(detector, Detector):
        raise TypeError(f"detector must be a Detector, got {type(detector).__name__}")
    if detector.mode not in ("nonparalyzable", "paralyzable"):
        raise ValueError(
            f"detector must be free-running to be calibrated from its stream, nonparalyzable or paralyzable, got mode "
            f"{detector.mode!r}"
        )
    for name, why in _UNKNOWN.items():
        if name in detector.effects:
            raise ValueError(f"detector must not have {name} here: it concerns {why}")
    return detector.without(*(name for name in _IN_THE_LIGHT if name in detector.effects))


def is_plain(detector: Detector) -> bool:
    """Whether the likelihood of a stream is exact: one dead time and nothing more."""
    return detector.mode == "nonparalyzable" and not set(detector.effects) - set(_IN_THE_LIGHT)


def moves_records(detector: Detector) -> bool:
    """Whether intervals may be shorter than the dead time, as records are not at the times of their avalanches."""
    return bool(set(detector.effects) & set(TIMING_EFFECTS))


def needs_simulation(detector: Detector) -> bool:
    """Whether the likelihood of a stream is not known: more than one dead time with Gaussian jitter, or recovery."""
    beyond = set(detector.effects) - set(_IN_THE_LIGHT)
    return detector.mode != "nonparalyzable" or not (beyond <= {"jitter"} or beyond == {"recovery_ns"})


def jitter_sigma(detector: Detector) -> float:
    """Sigma of the detector's jitter, ns; ValueError for one that is not Gaussian."""
    jitter = detector.jitter
    if jitter is None:
        return 0.0
    _gaussian(None, jitter)
    return jitter.std_ns


def watched(detector: Detector) -> tuple[float, float]:
    """Smallest interval between records that a detector allows, and the age from which on a pixel is armed, ns.

    Behind electronics that are dead for t_e > t_d the pixel may have fired again, unseen, until t_e: it is armed for
    certain t_d after that (Rapp et al. 2019).
    """
    dead, electronics = detector.dead_time_ns, detector.electronics_dead_time_ns
    return (electronics, electronics + dead) if electronics > dead else (dead, dead)


def recorded_pulse(system: System) -> Pulse:
    """The pulse as the records show it: blurred by the detector's jitter, where that is Gaussian.

    A measured pulse must be told about its centroid, which a jitter leaves in its place.
    """
    jitter, pulse = system.detector.jitter, system.pulse
    if jitter is None:
        return pulse
    if isinstance(pulse, SampledPulse) and pulse.origin == "centroid":
        return after_blur(pulse, jitter_sigma(system.detector))
    sigma = _gaussian(pulse, jitter)
    return GaussianPulse(sigma_ns=math.hypot(sigma, jitter.std_ns))


def pulse_of_the_light(recorded: Pulse, detector: Detector) -> Pulse:
    """The pulse behind a recorded one: without the detector's jitter, where both are Gaussian."""
    jitter = detector.jitter
    if jitter is None:
        return recorded
    sigma = _gaussian(recorded, jitter)
    if sigma <= jitter.std_ns:
        raise ValueError(
            f"the detector's jitter must be less than the recorded pulse of sigma {sigma:.4g} ns, which holds it, "
            f"got {jitter.std_ns:.4g} ns"
        )
    return GaussianPulse(sigma_ns=math.sqrt(sigma**2 - jitter.std_ns**2))


def _gaussian(pulse: Pulse | None, jitter: object) -> float:
    """Sigma of the pulse, 0 without one."""
    gaussian = isinstance(jitter, Jitter) and jitter.tail_fraction == 0.0
    if not gaussian or not (pulse is None or isinstance(pulse, GaussianPulse)):
        raise ValueError(
            "jitter and pulse are told apart only where both are Gaussian (or the pulse is a measured one about its "
            "centroid): leave the detector's jitter out, and give the pulse as it was recorded, jitter and all"
        )
    return pulse.sigma_ns if isinstance(pulse, GaussianPulse) else 0.0
