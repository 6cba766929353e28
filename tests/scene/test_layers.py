"""Scenes of several surfaces: panes, files of layers, and what cannot be; parts of transients that stay on disk."""

import itertools

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar.io.rgbd import read_layers
from mars_lidar.light.fog import Fog
from mars_lidar.light.transient import Transient
from mars_lidar.scene.scene import LayeredScene

SYSTEM = make_system(30.0, 50, 32)


def test_a_pane_hides_behind_what_is_nearer():
    scene = ml.Scene([[1.0, 4.0, np.nan]], 0.5, [[1.0, 2.0, 3.0]])
    visible = LayeredScene.behind_pane(scene, 2.0, 0.1, 0.8)
    np.testing.assert_array_equal(visible.layers[1].depth_m, [[np.nan, 2.0, 2.0]])
    np.testing.assert_allclose(visible.reflectivity, [[0.5, 0.4, 0.4]])
    assert visible.valid.all()
    flux = visible.flux(SYSTEM, signal=2.0, sbr=4.0)
    assert flux.returns_signal.shape == (2, 1, 3)
    assert flux.signal.mean() == pytest.approx(2.0)
    np.testing.assert_allclose(flux.returns_signal[:, 0, 1] / flux.signal[0, 0], [0.8, 0.2])
    np.testing.assert_allclose(flux.background, 0.5 * np.array([[0.5, 1.0, 1.5]]))  # the map of the first layer
    near = visible.flux(SYSTEM, signal=2.0, sbr=4.0, attenuation="inverse_square", ambient="reflectivity")
    np.testing.assert_allclose(near.returns_signal[:, 0, 1] / near.signal[0, 0], [0.4 / 16 / 0.5, 0.1 / 4 / 0.5])
    np.testing.assert_allclose(near.background / near.background[0, 0], [[1.0, 1.0, 0.2]])  # the last: the pane alone
    twice = LayeredScene.behind_pane(visible, 1.5, 0.2)
    assert len(twice.layers) == 3
    assert twice[:, 1:].shape == (1, 2)
    assert twice.resize((2, 6)).shape == (2, 6)


@pytest.mark.filterwarnings("ignore:.* have no return")
def test_ambient_light_of_layers_in_any_order():
    nan, rng = np.nan, np.random.default_rng(5)
    depths = [[[1.0, nan, nan, 3.0, nan]], [[2.0, 2.0, nan, nan, nan]], [[4.0, nan, 4.0, nan, nan]]]
    layers = [ml.Scene(depth, rng.uniform(0.1, 0.9, (1, 5))) for depth in depths]
    share = [item.reflectivity[0] for item in layers]
    sums = [share[0][0] + share[1][0] + share[2][0], share[1][1], share[2][2], share[0][3], max(s[4] for s in share)]
    for order in itertools.permutations(range(3)):
        flux = LayeredScene([layers[k] for k in order]).flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
        np.testing.assert_allclose(flux.background[0] / flux.background[0, 1], np.array(sums) / sums[1], rtol=1e-12)
        assert flux.background[0, :4].mean() == pytest.approx(0.5)  # over the pixels with a return
    alone = layers[0].flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
    item = LayeredScene(layers[:1]).flux(SYSTEM, signal=2.0, sbr=4.0, ambient="reflectivity")
    np.testing.assert_array_equal(alone.background, item.background)


def test_bad_layers(tmp_path):
    item = ml.Scene(np.ones((2, 2)), 1.0)
    for layers, message in (([], "1 to 16"), ([item] * 17, "1 to 16"), ([item, ml.Scene([[1.0]], 1.0)], "one shape")):
        refused(message, LayeredScene, layers)
    for arguments, name in (((0.0, 0.1), "depth_m"), ((1.0, 2.0), "reflectivity"), ((1.0, 0.1, 0.0), "transmission")):
        refused(f"{name} must be", LayeredScene.behind_pane, item, *arguments)
    path = tmp_path / "s.npz"
    depth = np.ones((2, 3, 4))
    for arrays, message in (
        ({"depth": depth[0]}, r"must be an \.npz with a depth of \(layers, H, W\)"),
        ({"depth": depth, "image": depth}, "give reflectivity, not image"),
        ({"depth": depth, "reflectivity": depth[0]}, "reflectivity must have the shape of depth"),
        ({"depth": depth, "reflectivity": 2 * depth}, r"reflectivity must lie in \[0, 1\]"),
        ({"depth": depth, "background": depth}, r"background must be real numbers \(H, W\)"),
        ({"depth": -depth}, "depth must not be negative"),
        ({"depth": depth.astype(np.uint16)}, "give depth_unit_m"),
        ({"depth": np.ones((17, 3, 4))}, "layers must be 1 to 16"),
    ):
        np.savez(path, **arrays)
        refused(message, read_layers, path)
    np.savez(path, depth=(1000 * depth).astype(np.uint16))
    np.testing.assert_array_equal(read_layers(path, depth_unit_m=0.001).layers[1].depth_m, depth[1])


def test_fog_made_by_rows_is_that_of_the_flux():
    rng = np.random.default_rng(0)
    clear = ml.Scene(rng.uniform(1.0, 12.0, (5, 4)), rng.uniform(0.1, 0.9, (5, 4))).flux(SYSTEM, signal=0.7, sbr=2.0)
    stored = Fog(extinction_per_m=0.1, backscatter=0.5).before(clear, SYSTEM, 0.7)
    whole = clear.in_fog(SYSTEM, extinction_per_m=0.1, backscatter=0.35)
    np.testing.assert_array_equal(stored[1:4].waveform, whole.waveform[1:4])
    np.testing.assert_allclose(stored.signal, whole.signal, rtol=1e-12)
    assert np.array_equal(ml.simulate(stored, SYSTEM, seed=1), ml.simulate(whole, SYSTEM, seed=1))
    refused("backscatter must be", Fog, extinction_per_m=0.1, backscatter=-1.0)


def test_parts_of_a_transient():
    values = np.random.default_rng(0).exponential(1.0, (6, 8, 5))
    transient = Transient(values, 0.5)
    crop = transient[4:1:-1, 1:7:2]
    np.testing.assert_array_equal(crop.rows(slice(0, 3)), values[4:1:-1, 1:7:2])
    np.testing.assert_array_equal(crop.rows(slice(1, 3)), values[3:1:-1, 1:7:2])
    np.testing.assert_allclose(transient.resize((3, 4)).rows(slice(0, 3)), values.reshape(3, 2, 4, 2, 5).mean((1, 3)))
    odd = transient.resize((4, 8))
    rows = [values[0] + 0.5 * values[1], 0.5 * values[1] + values[2], values[3] + 0.5 * values[4]]
    np.testing.assert_allclose(odd.rows(slice(0, 3)), np.stack(rows) / 1.5)
    np.testing.assert_allclose(odd.totals.sum() / 4, values.sum() / 6)
    assert Transient(values, 0.5, totals=values.sum(-1)).totals.shape == (6, 8)
    refused("totals must have shape", Transient, values, 0.5, totals=[1.0])
    with pytest.raises(IndexError, match="selects no pixel"):
        transient[6:]
