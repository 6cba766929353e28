"""Bad input, argument by argument: the message names it, the value and what is allowed, before any work."""

import math
from collections.abc import Callable
from typing import Any

import harness
import numpy as np
import pytest

import mars_lidar as ml

GOOD = {
    "period_ns": 100.0,
    "cycles": 10,
    "bins": 8,
    "pulse": ml.GaussianPulse(sigma_ns=1.0),
    "detector": ml.Detector(dead_time_ns=50.0),
}
SYSTEM = ml.System(**GOOD)
FLUX = ml.Flux(np.ones((2, 3)), 0.5, 20.0)
NAN, INF = math.nan, math.inf


def refused(call: Callable[[], Any], kind: type[Exception], *fragments: str) -> str:
    message = harness.refused("", call, error=kind)
    for fragment in fragments:
        assert fragment in message, f"{fragment!r} is not in {message!r}"
    return message


@pytest.mark.parametrize(
    ("field", "value", "kind", "fragments"),
    [
        ("period_ns", 0.0, ValueError, ["(0, inf)", "got 0.0"]),
        ("cycles", 0, ValueError, ["[1, ", "got 0"]),
        ("cycles", 2**54, ValueError, ["[1, ", f"got {2**54}"]),
        ("cycles", 1000.5, TypeError, ["integer", "got 1000.5", "float"]),
        ("bins", 0, ValueError, ["[1, 1048576]", "got 0"]),
        ("bins", 2**20 + 1, ValueError, ["[1, 1048576]", "got 1048577"]),
        ("pulse", None, TypeError, ["GaussianPulse", "SampledPulse", "got None"]),
        ("detector", {"dead_time_ns": 5.0}, TypeError, ["Detector", "dead_time_ns"]),
        ("start", "warm", ValueError, ["'armed'", "'stationary'", "got 'warm'"]),
    ],
)
def test_system(field: str, value: Any, kind: type[Exception], fragments: list[str]):
    refused(lambda: ml.System(**GOOD | {field: value}), kind, field, *fragments)


def test_system_needs_all_its_fields_by_name():
    for field in GOOD:
        rest = {k: v for k, v in GOOD.items() if k != field}
        refused(lambda rest=rest: ml.System(**rest), TypeError, field)
    refused(lambda: ml.System(100.0), TypeError)
    refused(lambda: ml.System(**GOOD, colour="red"), TypeError, "colour")


def test_system_as_a_whole():
    def gaussian(sigma: float) -> Callable[[], ml.System]:
        return lambda: ml.System(**GOOD | {"pulse": ml.GaussianPulse(sigma_ns=sigma)})

    refused(gaussian(5e-5), ValueError, "sigma_ns", "[0.0001, 100] ns", "got 5e-05")
    refused(gaussian(101.0), ValueError, "sigma_ns", "[0.0001, 100] ns", "got 101")
    long = ml.SampledPulse(np.ones(11), 10.0)
    refused(lambda: ml.System(**GOOD | {"pulse": long}), ValueError, "values", "100 ns", "11 samples", "110 ns")
    dead = ml.Detector(dead_time_ns=2e8)
    refused(lambda: ml.System(**GOOD | {"detector": dead}), ValueError, "dead_time_ns", "1048576 periods", "2e+08")


@pytest.mark.parametrize(
    ("make", "kind", "fragments"),
    [
        (lambda: ml.GaussianPulse(sigma_ns=0.0), ValueError, ["sigma_ns", "(0, inf)", "got 0.0"]),
        (lambda: ml.GaussianPulse(sigma_ns=np.ones(2)), TypeError, ["sigma_ns", "number", "ndarray"]),
        (lambda: ml.GaussianPulse.from_fwhm(fwhm_ns=0.0), ValueError, ["fwhm_ns", "(0, inf)", "got 0.0"]),
        (lambda: ml.SampledPulse([], 1.0), ValueError, ["values", "1 to", "(0,)"]),
        (lambda: ml.SampledPulse([[1.0]], 1.0), ValueError, ["values", "(n,)", "(1, 1)"]),
        (lambda: ml.SampledPulse([1.0, -2.0], 1.0), ValueError, ["values", "non-negative", "values[1] = -2.0"]),
        (lambda: ml.SampledPulse([1.0, NAN], 1.0), ValueError, ["values", "finite", "values[1] = nan"]),
        (lambda: ml.SampledPulse([0.0, 0.0], 1.0), ValueError, ["values", "positive", "a sum of 0.0"]),
        (lambda: ml.SampledPulse([1.0], 0.0), ValueError, ["bin_ns", "(0, inf)", "got 0.0"]),
        (lambda: ml.SampledPulse([1.0], 1.0, "middle"), ValueError, ["origin", "'centroid'", "got 'middle'"]),
        (lambda: ml.SampledPulse(np.ones(4), 1.0, "centroid"), ValueError, ["centroid", "flat"]),
    ],
)
def test_pulse(make: Callable[[], Any], kind: type[Exception], fragments: list[str]):
    refused(make, kind, *fragments)


def flux_call(*args: Any, **kwargs: Any) -> Callable[[], ml.Flux]:
    return lambda: ml.Flux(*args, **kwargs)


RANGE = "[0, 1e+06] photons per period"


@pytest.mark.parametrize(
    ("make", "kind", "fragments"),
    [
        (flux_call(-1.0, 0.0, 5.0), ValueError, ["signal", RANGE, "got -1.0"]),
        (flux_call(2e6, 0.0, 5.0), ValueError, ["signal", RANGE, "got 2000000.0"]),
        (flux_call([[1.0, 1.0], [1.0, INF]], 0.0, 5.0), ValueError, ["signal", RANGE, "got inf", "(1, 1)"]),
        (flux_call(np.ones((1, 1, 1)), 0.0, 5.0), ValueError, ["delay_ns", "(R, H, W)", "(1, 1, 1)"]),
        (flux_call(np.ones((0, 3)), 0.0, 5.0), ValueError, ["signal", "at least one pixel", "(0, 3)"]),
        (flux_call(), ValueError, ["signal must be given", "waveform"]),
        (flux_call(1.0, -0.5, 5.0), ValueError, ["background", RANGE, "got -0.5"]),
        (flux_call(1.0, 0.0), ValueError, ["delay_ns", "signal > 0"]),
        (flux_call([[1.0, 1.0]], 0.0, [[NAN, 1.0]]), ValueError, ["delay_ns", "finite", "NaN at pixel (0, 0)"]),
        (flux_call(np.ones((2, 3)), np.ones((3, 2)), 5.0), ValueError, ["signal (2, 3)", "background (3, 2)"]),
        (flux_call(1.0, waveform=[1.0]), ValueError, ["waveform replaces signal"]),
        (flux_call(delay_ns=1.0, waveform=[1.0]), ValueError, ["waveform replaces", "delay_ns"]),
        (flux_call(waveform=[1.0, -1.0]), ValueError, ["waveform", RANGE, "got -1.0", "(1,)"]),
        (flux_call(waveform=np.full(1000, 2e3)), ValueError, ["waveform summed over a period", RANGE]),
        (flux_call(waveform=[]), ValueError, ["waveform", "(H, W, T)", "(0,)"]),
        (flux_call(waveform=1.0), ValueError, ["waveform", "(T,)", "()"]),
        (flux_call(waveform=np.ones((1,) * 4)), ValueError, ["waveform", "(H, W, T)", "(1, 1, 1, 1)"]),
        (flux_call(waveform=np.ones((2, 3, 4)), background=np.ones((5, 3))), ValueError, ["waveform (2, 3)", "(5, 3)"]),
        (lambda: ml.Flux.multi(), TypeError, ["multi", "Flux", "got ()"]),
        (lambda: ml.Flux.multi(FLUX, 1.0), TypeError, ["multi", "Flux"]),
        (lambda: ml.Flux.multi(FLUX, ml.Flux(waveform=[1.0])), ValueError, ["multi", "waveforms", "returns"]),
        (lambda: ml.Flux.multi(ml.Flux(waveform=[1.0]), ml.Flux(waveform=[1.0, 1.0])), ValueError, ["equal", "[1, 2]"]),
        (lambda: ml.Flux.multi(FLUX, ml.Flux(np.ones((4, 3)), 0.0, 1.0)), ValueError, ["fluxes[1] (4, 3)"]),
        (lambda: FLUX[2], IndexError, ["2", "2 pixels"]),
        (lambda: FLUX[0, -4], IndexError, ["-4", "3 pixels"]),
        (lambda: FLUX[0, 0, 0], IndexError, ["rows, columns", "3"]),
        (lambda: FLUX[[0, 1]], IndexError, ["integers and slices", "[0, 1]"]),
        (lambda: FLUX[1:1], IndexError, ["no pixel", "(2, 3)"]),
    ],
)
def test_flux(make: Callable[[], Any], kind: type[Exception], fragments: list[str]):
    refused(make, kind, *fragments)


CALLS = [
    ("engine", "fast", ValueError, ["'exact'", "'sequential'", "'poisson'", "got 'fast'"]),
    ("seed", -1, ValueError, [f"[0, {2**64 - 1}]", "got -1"]),
    ("seed", 2**64, ValueError, [f"[0, {2**64 - 1}]", f"got {2**64}"]),
    ("threads", 0, ValueError, ["[1, 1024]", "got 0"]),
    ("threads", 5000, ValueError, ["[1, 1024]", "got 5000"]),
    ("pixel_index", [0, 1, 2], ValueError, ["(6,) or (2, 3)", "got (3,)"]),
    ("pixel_index", np.zeros((3, 2), int), ValueError, ["(6,) or (2, 3)", "got (3, 2)"]),
    ("pixel_index", [-1, 0, 1, 2, 3, 4], ValueError, ["[0, 2**32)", "got -1 to 4"]),
    ("pixel_index", [0, 1, 2, 3, 4, 2**32], ValueError, ["[0, 2**32)", f"to {2**32}"]),
    ("pixel_index", np.arange(6.0), TypeError, ["integers", "float64"]),
]
HISTOGRAM_CALLS = [
    ("realizations", 0, ValueError, ["[1, 4294967296]", "got 0"]),
    ("realizations", 2**32 + 1, ValueError, ["[1, 4294967296]", f"got {2**32 + 1}"]),
    ("first_realization", -1, ValueError, ["[0, 4294967295]", "got -1"]),
    ("first_realization", 2**32, ValueError, ["[0, 4294967295]", f"got {2**32}"]),
    ("out", np.zeros((1, 2, 3, 9), np.uint16), ValueError, ["(1, 2, 3, 8)", "uint16", "got (1, 2, 3, 9)"]),
    ("out", np.zeros((1, 2, 3, 8), np.uint32), ValueError, ["(1, 2, 3, 8)", "uint16", "uint32"]),
    ("out", np.zeros((1, 2, 3, 8), ">u2"), ValueError, ["uint16", ">u2"]),
    ("out", np.zeros((1, 2, 3, 8), np.uint16, order="F"), ValueError, ["C-contiguous"]),
    ("out", np.zeros((1, 2, 3, 16), np.uint16)[..., ::2], ValueError, ["C-contiguous"]),
]


@pytest.mark.parametrize(("argument", "value", "kind", "fragments"), CALLS + HISTOGRAM_CALLS)
def test_simulate(argument: str, value: Any, kind: type[Exception], fragments: list[str]):
    refused(lambda: ml.simulate(FLUX, SYSTEM, **{argument: value}), kind, argument, *fragments)


@pytest.mark.parametrize(
    ("argument", "value", "kind", "fragments"),
    [
        *CALLS,
        ("realization", -1, ValueError, ["[0, 4294967295]", "got -1"]),
        ("realization", 2**32, ValueError, ["[0, 4294967295]", f"got {2**32}"]),
    ],
)
def test_simulate_timestamps(argument: str, value: Any, kind: type[Exception], fragments: list[str]):
    message = refused(lambda: ml.simulate_timestamps(FLUX, SYSTEM, **{argument: value}), kind, *fragments)
    assert message.startswith(f"{argument} must "), message  # the caller's word for it


@pytest.mark.parametrize("verb", [ml.simulate, ml.simulate_timestamps])
def test_what_is_simulated(verb: Callable[..., Any]):
    refused(lambda: verb(np.ones((2, 3)), SYSTEM), TypeError, "flux must be a Flux", "ndarray")
    refused(lambda: verb(FLUX, {"bins": 8}), TypeError, "system must be a System", "dict")
    refused(lambda: verb(FLUX), TypeError, "system")
    refused(lambda: verb(FLUX, SYSTEM, 3), TypeError)  # options by name only
    refused(lambda: verb(FLUX, SYSTEM, colour="red"), TypeError, "colour")
    many = ml.Flux.multi(*[FLUX] * 17)
    refused(lambda: verb(many, SYSTEM), ValueError, "flux", "at most 16 returns", "got 17", "waveform")
    endless = SYSTEM.replace(cycles=10**8, detector=ml.Detector(dead_time_ns=0.0))
    bright = ml.Flux(1000.0, 0.0, 5.0)
    refused(lambda: verb(bright, endless), ValueError, "2.15e+09 expected registrations", "got 1e+11", "1000 photons")


def test_realizations_end_at_the_last_number():
    """first_realization + realizations may not pass 2**32: the stream is keyed by 32 bits."""
    kwargs = {"first_realization": 2**32 - 2}
    refused(lambda: ml.simulate(FLUX, SYSTEM, realizations=3, **kwargs), ValueError, "realizations", "[1, 2]", "got 3")
    assert ml.simulate(FLUX, SYSTEM, realizations=2, **kwargs).shape[0] == 2


def test_read_only_out_is_refused():
    out = np.zeros((1, 2, 3, 8), np.uint16)
    out.flags.writeable = False
    refused(lambda: ml.simulate(FLUX, SYSTEM, out=out), ValueError, "out", "writeable")


def test_no_work_is_done_for_bad_input():
    """`out` stays as it was."""
    out = np.full((1, 2, 3, 8), 7, np.uint16)
    refused(lambda: ml.simulate(FLUX, SYSTEM, out=out, seed=-1), ValueError, "seed")
    assert (out == 7).all()


def test_a_masked_pixel_is_not_taken_for_what_lies_under_the_mask():
    mask = [[False, True, False], [False, False, False]]
    light = np.ma.MaskedArray(np.ones((2, 3)), mask=mask)
    refused(lambda: ml.Flux(light, 0.5, 20.0), ValueError, "signal", "nan at index (0, 1)")
    refused(lambda: ml.Flux(1.0, light, 20.0), ValueError, "background", "nan at index (0, 1)")
    refused(lambda: ml.Flux(1.0, 0.5, light), ValueError, "delay_ns", "(0, 1)")
    assert np.isnan(ml.Flux(np.where(mask, 0.0, 1.0), 0.5, light).delay_ns[0, 1])  # no light: no return


def test_masks_are_honoured_or_refused_by_name():
    def masked(values):
        return np.ma.MaskedArray(values, mask=np.arange(np.size(values)).reshape(np.shape(values)) == 1)

    cube = ml.simulate(FLUX, SYSTEM)
    pixels = int(np.prod(FLUX.shape))
    refused(lambda: ml.reconstruct(masked(cube), SYSTEM), ValueError, "cube must have no masked elements")
    index = masked(np.arange(pixels))
    refused(
        lambda: ml.simulate(FLUX, SYSTEM, pixel_index=index), ValueError, "pixel_index must have no masked elements"
    )
    refused(lambda: ml.SampledPulse(masked([1.0, 5.0, 2.0]), 0.1), ValueError, "values must have no masked elements")
    assert ml.SampledPulse(np.ma.MaskedArray([1.0, 5.0, 2.0]), 0.1) == ml.SampledPulse([1.0, 5.0, 2.0], 0.1)


def test_counts_are_whole_numbers():
    cube = ml.simulate(FLUX, SYSTEM)
    refused(lambda: ml.reconstruct(cube > 0, SYSTEM), TypeError, "cube must hold counts", "got dtype bool")
    refused(lambda: ml.reconstruct(cube - 7.0, SYSTEM), ValueError, "cube must hold finite counts >= 0, got -7")
    refused(lambda: ml.reconstruct(cube.astype(int) - 7, SYSTEM), ValueError, "cube must hold counts >= 0, got -7")
    refused(lambda: ml.reconstruct(cube + 0.25, SYSTEM), ValueError, "cube must hold whole counts, got")
    assert np.array_equal(ml.reconstruct(cube + 0.0, SYSTEM).signal, ml.reconstruct(cube, SYSTEM).signal)


def test_memory_for_timestamps_is_estimated_before_they_are_counted(monkeypatch):
    monkeypatch.setattr(
        "mars_lidar.engines.exact.ExactEngine.counts", lambda *_: pytest.fail("the exposure was counted")
    )
    bright = ml.Flux(np.full((100, 100), 20.0), 1.0, 20.0)
    monkeypatch.setattr("mars_lidar._base.resources.available_bytes", lambda: 2**20)
    with pytest.raises(MemoryError, match="timestamps of shape"):
        ml.simulate_timestamps(bright, SYSTEM)


def test_what_is_no_array_of_counts_is_named_by_its_type(tmp_path):
    from mars_lidar import io

    io.simulate_to(tmp_path / "a.zarr", FLUX, SYSTEM)
    cube = io.load(tmp_path / "a.zarr")
    refused(lambda: ml.reconstruct([cube, cube], SYSTEM), TypeError, "its histogram", "got list")
    refused(lambda: ml.reconstruct(cube.histogram[:]), TypeError, "system must be given")
    refused(lambda: ml.reconstruct("a.zarr", SYSTEM), TypeError, "array of counts", "got str")
    refused(lambda: ml.calibrate(np.zeros((3, 8))), ValueError, "times must be finite numbers (n,)")


def test_a_file_of_another_kind_says_what_it_is(tmp_path):
    from mars_lidar import io
    from mars_lidar.io.maps import save_maps

    cube = ml.simulate(FLUX, SYSTEM)
    save_maps(tmp_path / "maps.npz", {"peak": ml.reconstruct(cube, SYSTEM, "peak")})
    ml.simulate_timestamps(FLUX, SYSTEM).save(tmp_path / "times.npz")
    ml.Table.build(SYSTEM, signal=(0.1, 1, 4), background=(0.1, 1, 4)).save(tmp_path / "table.h5")
    for name, message in (("maps.npz", "load_maps"), ("times.npz", "Timestamps.load"), ("table.h5", "Table.load")):
        refused(lambda name=name: io.load(tmp_path / name), ValueError, name, "not a cube", message)
    io.simulate_to(tmp_path / "a.zarr", FLUX, SYSTEM)
    refused(lambda: ml.Table.load(tmp_path / "a.zarr", SYSTEM), ValueError, "a.zarr is not a table")
