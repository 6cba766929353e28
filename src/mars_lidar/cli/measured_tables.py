"""What the commands for measured streams print, row by row."""

from __future__ import annotations

from mars_lidar.calibrate import ArrivalInspection, Calibration
from mars_lidar.calibrate.detector_model import moves_records
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.system import SPEED_OF_LIGHT_M_PER_NS

_APART = 5.0  # standard errors


def clock_rows(found: Calibration) -> list[tuple[str, str]]:
    """Laser, duration and rate."""
    counted = found.summary
    seconds = 1e-9 * counted.period_ns * counted.cycles
    unit = f", clock unit {1e3 * counted.unit_ns:.5g} ps" if counted.unit_ns else ""
    return [
        (
            "laser",
            f"period {counted.period_ns:.7g} ns ({1e3 / counted.period_ns:.5g} MHz), {counted.cycles:,} periods, "
            f"{seconds:.4g} s{unit}",
        ),
        ("rate", f"{counted.rate_per_s:,.6g} counts/s, {counted.per_period:.5g} a period"),
    ]


def interval_rows(found: Calibration, estimated: bool) -> list[tuple[str, str]]:
    """Intervals and dead time."""
    counted = found.summary
    low, middle, high = counted.quantiles_ns
    dead = f"{found.dead_time_ns:.6g} ns"
    if estimated:
        told = {"edge": "the middle of an edge that jitter blurs", "recovery": "a slow recovery"}
        by = told.get(found.dead_time_by, "the smallest interval")
        dead += f" ± {found.dead_time_error_ns:.2g}, by {by}" if found.edge_fits else ": not known"
    rows = [
        ("intervals", f"smallest {counted.smallest_ns[0]:.6g} ns; 1, 50, 99 %: {low:.5g}, {middle:.5g}, {high:.5g} ns"),
        ("dead time", dead),
    ]
    if found.jitter_ns:
        error = f" ± {found.jitter_error_ns:.2g}, by that edge" if found.jitter_error_ns else ", given"
        rows.append(("jitter", f"sigma {found.jitter_ns:.4g} ns{error}; the recorded pulse holds it"))
    elif not found.edge_fits:
        rows.append(("jitter", "not known"))
    elif found.jitter_limit_ns:
        rows.append(("jitter", f"none seen: the edge is sharp; one below {found.jitter_limit_ns:.2g} ns could hide"))
    return rows


def light_rows(found: Calibration, detector: Detector | None = None) -> list[tuple[str, str]]:
    """What was calibrated; `detector` is told, with its effects."""
    rows = interval_rows(found, found.dead_time_error_ns != 0)
    if found.hold_off_ns > found.dead_time_ns + found.dead_time_error_ns:
        rows.append(("hold-off", f"{found.hold_off_ns:.5g} ns: {found.armed.left_out:,} photons not used"))
    if found.summary.same_time:
        rows.append(("does not fit", f"{found.summary.same_time:,} photons at exactly the time of the one before"))
    if found.too_short:
        expected = detector is not None and moves_records(detector)
        smallest = f"the smallest {found.summary.smallest_ns[0]:.5g} ns"
        told = f"{found.too_short:,} intervals shorter than the dead time, {smallest}"
        rows.append(("by jitter" if expected else "does not fit", told))
    rows += [("not known", text) for text in found.unknown]
    errors = found.errors
    if found.waveform is not None:
        rows.append(("light", f"{found.total:.6g} ± {found.total_error:.2g} photons per period, any shape"))
    else:
        rows.append(("background B", f"{found.background:.6g} ± {errors['background']:.2g} photons per period"))
        many = found.returns_signal.size > 1
        for k, (signal, delay) in enumerate(zip(found.returns_signal, found.returns_delay_ns, strict=True), start=1):
            tail, which = (f"_{k}", f" {k}") if many else ("", "")
            depth = 0.5 * SPEED_OF_LIGHT_M_PER_NS * delay
            rows.append((f"signal S{which}", f"{signal:.6g} ± {errors[f'signal{tail}']:.2g} photons per period"))
            error = errors[f"delay_ns{tail}"]
            told = f"{delay:.7g} ± {error:.2g} ns, {depth:.6g} m"
            if error != error and (not found.unknown or any("no pulse" in text for text in found.unknown)):
                told = "none: no signal is seen"
            rows.append((f"delay{which}", told))
        width = errors.get("sigma_ns", 0.0)
        if width == width:
            rows.append(("pulse", f"{found.pulse!r}" + (f", sigma ± {width:.2g} ns (fitted)" if width else "")))
    if found.simulated:
        longer = f"streams {found.simulated:.3g} times as long"
        rows.append(("by simulation", f"bias by the detector's effects taken off, by {longer}"))
    rapp = found.rapp
    split = "" if rapp.signal != rapp.signal else f"; by shape B {rapp.background:.5g}, S {rapp.signal:.5g}"
    rows.append(
        (
            "by Rapp",
            f"Lambda {rapp.total:.6g} ± {rapp.total_error:.2g}, above {found.total:.6g} ± "
            f"{found.total_error:.2g}{split}",
        )
    )
    if abs(found.disagreement) > _APART:
        rows.append(
            (
                "does not fit",
                f"Rapp's Lambda is {abs(found.disagreement):.0f} standard errors off: a wrong laser "
                "period or dead time, afterpulses, or light that is not constant: see `mars-lidar inspect`",
            )
        )
    return rows


def arrival_rows(found: ArrivalInspection) -> list[tuple[str, str]]:
    """A detector in constant light, of a recording without a laser."""
    low, middle, high = found.quantiles_ns
    unit = f", clock unit {1e3 * found.unit_ns:.5g} ps" if found.unit_ns else ""
    known = found.dead_time_ns == found.dead_time_ns
    dead = f"{found.dead_time_ns:.6g} ± {found.dead_time_error_ns:.2g} ns" if known else "not known"
    seen = f"{found.afterpulse_probability:.4g} ± {found.afterpulse_error:.2g} a registration"
    if found.afterpulse_probability == 0.0:
        seen = f"none seen: 0 ± {found.afterpulse_error:.2g} a registration"
    return [
        ("laser", f"none told: arrivals over {1e-9 * found.duration_ns:.4g} s{unit}"),
        ("rate", f"{found.rate_per_s:,.6g} ± {found.rate_error_per_s:.2g} per second of an armed detector"),
        ("intervals", f"smallest {found.smallest_ns[0]:.6g} ns; 1, 50, 99 %: {low:.5g}, {middle:.5g}, {high:.5g} ns"),
        ("dead time", dead),
        *([("jitter", f"sigma {found.jitter_ns:.4g} ns, by the edge of the intervals")] if found.jitter_ns else []),
        ("afterpulses", f"{seen}, within {found.afterpulse_until_ns:.4g} ns" if known else "not known"),
        *[("not known", text) for text in found.unknown],
        *[("does not fit", text) for text in found.problems or ("nothing",)],
    ]
