"""Flux: maps, broadcasting, returns, waveforms, parts of an image."""

import numpy as np
import pytest
from harness import refused

import mars_lidar as ml


def test_scalars_are_one_pixel():
    flux = ml.Flux(0.5, 0.2, 30.0)
    assert flux.shape == flux.signal.shape == flux.background.shape == flux.delay_ns.shape == ()
    assert flux.returns_signal.shape == flux.returns_delay_ns.shape == (1,)
    assert flux.image.shape == (1, 1)
    assert flux.image.returns_signal.shape == (1, 1, 1)
    assert flux.total.item() == pytest.approx(0.7)
    assert flux.waveform is None


def test_broadcasting():
    flux = ml.Flux([[0.5], [1.0]], [[0.1, 0.2, 0.3]], 7.0)
    assert flux.shape == (2, 3)
    assert flux.signal[1].tolist() == [1.0, 1.0, 1.0]
    assert flux.background[:, 2].tolist() == [0.3, 0.3]
    assert np.all(flux.delay_ns == 7.0)
    row = ml.Flux([0.5, 1.0], 0.1, 7.0)
    assert row.shape == (2,)
    assert row.image.shape == (1, 2)


def test_background_alone_needs_no_delay():
    flux = ml.Flux(0.0, 0.5)
    assert flux.signal.item() == 0.0
    assert ml.Flux([[0.0, 1.0]], 0.5, [[np.nan, 3.0]]).shape == (1, 2)  # no return: NaN delay


def test_maps_are_copies_and_read_only():
    signal = np.ones((2, 2))
    flux = ml.Flux(signal, 0.0, 5.0)
    signal[:] = 9.0
    assert np.all(flux.signal == 1.0)
    for array in (flux.signal, flux.background, flux.delay_ns, flux.returns_signal, flux.returns_delay_ns):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    with pytest.raises(AttributeError):
        flux.signal = signal  # type: ignore[misc]


@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8, bool])
def test_any_real_type(dtype: type):
    assert ml.Flux(np.ones((2, 2), dtype), np.zeros((2, 2), dtype), 5).total.tolist() == [[1.0, 1.0], [1.0, 1.0]]


def test_waveform():
    flux = ml.Flux(waveform=[0.0, 0.5, 0.25], background=0.1)
    assert flux.shape == ()
    assert flux.waveform.shape == (3,)
    assert flux.image.waveform.shape == (1, 1, 3)
    assert flux.signal.item() == 0.75
    assert np.isnan(flux.delay_ns.item())
    assert flux.returns_signal.shape == (0,)
    image = ml.Flux(waveform=np.ones((2, 3, 5)), background=[[0.1, 0.2, 0.3]])
    assert image.shape == (2, 3)
    assert image.background.shape == (2, 3)
    assert ml.Flux(waveform=np.ones(4), background=np.zeros((2, 2))).waveform.shape == (2, 2, 4)
    with pytest.raises(ValueError, match="read-only"):
        image.waveform[...] = 0


def test_multi_puts_returns_side_by_side():
    glass, wall = ml.Flux(0.1, 0.2, 5.0), ml.Flux([[0.5, 0.05]], 0.1, 40.0)
    both = ml.Flux.multi(glass, wall, info={"what": "window"})
    assert both.shape == (1, 2)
    assert both.returns_signal[:, 0].tolist() == [[0.1, 0.1], [0.5, 0.05]]
    assert both.signal[0] == pytest.approx([0.6, 0.15])
    assert both.background[0] == pytest.approx([0.3, 0.3])
    assert both.delay_ns.tolist() == [[40.0, 5.0]]  # of the strongest
    assert both.info == {"what": "window"}
    three = ml.Flux.multi(both, ml.Flux(0.0, 0.0, np.nan))
    assert len(three.returns_signal) == 3
    assert three.delay_ns.tolist() == [[40.0, 5.0]]


def test_multi_adds_waveforms():
    both = ml.Flux.multi(ml.Flux(waveform=[1.0, 0.0], background=0.1), ml.Flux(waveform=[[[0.5, 0.5]]], background=0.2))
    assert both.waveform[0, 0].tolist() == [1.5, 0.5]
    assert both.background.item() == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        (0, (3,)),
        (-1, (3,)),
        ((1, 2), ()),
        ((1, -1), ()),
        (slice(0, 1), (1, 3)),
        ((slice(None), 1), (2,)),
        ((slice(None), slice(None, None, 2)), (2, 2)),
        ((slice(None, None, -1),), (2, 3)),
    ],
)
@pytest.mark.parametrize("kind", ["returns", "waveform"])
def test_parts(key, shape: tuple[int, ...], kind: str):
    """Integers take their axis away, as in an array."""
    maps = np.arange(6.0).reshape(2, 3)
    flux = ml.Flux.multi(ml.Flux(maps, 0.1 * maps, maps), ml.Flux(2 * maps, 0.0, -maps))
    if kind == "waveform":
        flux = ml.Flux(waveform=maps[..., None] * np.ones(4), background=0.1 * maps)
    part = flux[key]
    assert part.shape == shape
    assert np.array_equal(part.signal, flux.signal[key])
    assert np.array_equal(part.background, flux.background[key])
    if kind == "waveform":
        assert part.waveform.shape == (*shape, 4)
    else:
        assert part.returns_delay_ns.shape == (2, *shape)


def test_printing():
    assert repr(ml.Flux(np.full((2, 3), 0.5), 0.25, 1.0)) == (
        "Flux(2 x 3 pixels, 1 return, mean signal 0.5, mean background 0.25 photons per period)"
    )
    assert "waveform of 7" in repr(ml.Flux(waveform=np.ones(7)))
    assert "2 returns" in repr(ml.Flux.multi(ml.Flux(1.0, 0.0, 1.0), ml.Flux(1.0, 0.0, 2.0)))


def test_info_is_the_fluxs_own():
    info = {"level": 1.0}
    flux = ml.Flux(1.0, 0.0, 5.0, info=info)
    info["level"] = 2.0
    assert flux.info == {"level": 1.0}
    assert flux.image[0].info == {"level": 1.0}
    assert ml.Flux(1.0, 0.0, 5.0).info == {}


def test_delays_beyond_a_second_are_refused():
    """Their phase is lost in the rounding of float64: 1e15 + 13 ns came out at another one than 13 ns."""
    refused(r"delay_ns must be within 1e\+09 ns either way, got 1e\+15; give it modulo", ml.Flux, 1.0, 0.1, 1e15 + 13.0)
    far, near = ml.Flux(1.0, 0.1, 1e9), ml.Flux(1.0, 0.1, 1e9 % 133.3)
    np.testing.assert_allclose(far.delay_periods(133.3), near.delay_periods(133.3), atol=1e-8)
