"""Own files that a stranger opened with NumPy, changed and saved again: all sums are right, the content is not."""

import numpy as np
import pytest
from harness import make_system, refused
from harness.files import rewrite, write_h5
from store_cases import SYSTEM, one_return

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import FileError
from mars_lidar.io.maps import load_maps, save_maps

COUNTS = {
    "negative": lambda counts: -counts.astype(np.int64),
    "NaN": lambda counts: np.where(counts > 0, counts, np.nan),
    "fractions": lambda counts: counts + 0.25,
    "complex": lambda counts: counts + 1j,
    "truth": lambda counts: counts > 0,
    "text": lambda counts: np.full(counts.shape, "abc"),
    "records": lambda counts: np.zeros(counts.shape, [("a", "i4")]),
    "times": lambda counts: np.zeros(counts.shape, "M8[ns]"),
    "of twice the type": lambda counts: counts.astype(np.uint32),
    "doubled": lambda counts: 2 * counts,
    "none": np.zeros_like,
    "of one row fewer": lambda counts: counts[:, 1:],
    "of one exposure more": lambda counts: np.concatenate([counts, counts[:1]]),
}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        *(("histogram", change) for change in COUNTS.values()),
        ("depth", lambda depth: np.full(depth.shape, np.inf)),
        ("depth", lambda depth: depth > 0),
        ("depth", lambda depth: np.full(depth.shape, 2**63 - 1)),
        ("signal", lambda signal: np.array(0.0)),
        ("signal", lambda signal: signal > 0),
        ("delay", lambda delay: delay.astype(np.float32)),
        ("attributes", lambda attributes: attributes.update(engine=0)),
        ("attributes", lambda attributes: attributes.update(version={})),
        ("attributes", lambda attributes: attributes.update(source=[1])),
    ],
)
def test_counts_light_and_attributes_of_an_archive_are_what_we_write(tmp_path, name, change):
    """Counts are counts and add up; what is wrong of them may show when they are read."""
    path = tmp_path / "cube.npz"
    io.simulate_to(path, one_return(), SYSTEM)
    rewrite(path, name, change)
    refused(r"cube\.npz", lambda: np.asarray(io.load(path).histogram), error=FileError)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("depth", lambda depth: depth[..., :-1]),
        ("signal", lambda signal: signal.astype(str)),
        ("flags", lambda flags: None),
        ("y", lambda y: y[::-1]),
        ("x", lambda x: x.astype(str)),
        ("x", lambda x: x[None]),
        ("realization", lambda numbers: numbers + 0.5),
        ("method", lambda names: np.arange(len(names))),
        ("method", lambda names: names[None]),
        ("attributes", lambda attributes: attributes.pop("system")),
        ("attributes", lambda attributes: attributes.update(level="{}")),
        ("attributes", lambda attributes: attributes.update(level='{"maximum_likelihood": "high"}')),
        ("attributes", lambda attributes: attributes.update(level='{"maximum_likelihood": -1}')),
        ("attributes", lambda attributes: attributes.update(level=3)),
        ("attributes", lambda attributes: attributes.update(source=None)),
        ("attributes", lambda attributes: attributes.update(version=1)),
    ],
)
def test_maps_and_their_labels_are_what_we_write(tmp_path, name, change):
    path = tmp_path / "maps.npz"
    cube = ml.Cube(ml.simulate(one_return(), SYSTEM), SYSTEM)
    save_maps(path, {"maximum_likelihood": ml.reconstruct(cube)}, source="a test")
    assert load_maps(path)[1]["source"] == "a test"
    rewrite(path, name, change)
    refused(r"maps\.npz", load_maps, path, error=FileError)


@pytest.mark.parametrize("values", [np.ones((2, 2, 8), bool), np.ones((2, 2, 8), complex), np.ones((2, 2, 8), "S3")])
def test_light_of_another_type_is_an_error_of_the_file(tmp_path, values):
    """It was a TypeError, as if the caller had given it."""
    write_h5(tmp_path / "light.h5", {"transient": values})
    path = tmp_path / "light.h5"
    refused(r"light\.h5.*real numbers", lambda: io.read_transient(path, bin_ns=0.5).flux(SYSTEM, signal=1.0))


ATTRIBUTES = [
    *[("period_ns", float("nan")), ("period_ns", -1.0), ("cycles", 0), ("cycles", 1.5), ("bins", 0), ("bins", 2**63)],
    *[("dtype", "float64"), ("dtype", "O"), ("shape", [-6, -5]), ("info", [])],
]
SYSTEMS = ["", {}, {"period_ns": 1.0}, [1], SYSTEM.replace(bins=2 * SYSTEM.bins).to_dict()]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("bin", lambda bins: bins[::-1], "bin must be that of times_ns"),
        ("bin", lambda bins: bins.astype(complex), "bin must be integers"),
        ("cycle", lambda cycle: cycle.astype(float), "cycle must be integers"),
        ("times_ns", lambda times: times.astype("M8[ns]"), "times_ns must be times"),
        *(("attributes", lambda attributes, new=new: attributes.update([new]), new[0]) for new in ATTRIBUTES),
        *(("attributes", lambda attributes, new=new: attributes["info"].update(system=new), "") for new in SYSTEMS),
    ],
)
def test_a_stream_is_what_we_write(tmp_path, name, change, message):
    ml.simulate_timestamps(one_return(), SYSTEM).save(tmp_path / "a.npz")
    rewrite(tmp_path / "a.npz", name, change)
    refused(rf"a\.npz.*{message}", ml.Timestamps.load, tmp_path / "a.npz", error=FileError)


@pytest.mark.parametrize("effect", [{"jitter": ml.Jitter(sigma_ns=0.5)}, {"code_density": (0.5, 1.5) * 16}])
def test_jittered_and_uneven_bins_are_stored(tmp_path, effect):
    times = ml.simulate_timestamps(one_return(), make_system(30.0, 50, 32, **effect))
    times.save(tmp_path / "a.npz")
    assert (ml.Timestamps.load(tmp_path / "a.npz").bin == times.bin).all()
