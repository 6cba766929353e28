"""The stream: the same samples whoever makes them, maps that belong to the cube, and settings within their ranges."""

import itertools
import math
import pickle
import sys
import threading
import warnings

import numpy as np
import pytest
import torch
from harness import make_system, refused
from scipy import stats
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar.learn import Choice, CubeStream, LogUniform, SystemRange, Uniform
from mars_lidar.learn.cube_stream import prefetched
from mars_lidar.learn.scenes import SharedScenes

SYSTEM = make_system(30.0, 60, 64)
SYSTEMS = SystemRange(
    base=SYSTEM,
    cycles=LogUniform(10, 200),
    period_ns=Uniform(80, 120),
    dead_time_ns=Choice([0, 20, 150.0]),
    sigma_ns=LogUniform(0.2, 2),
)


def stream(systems=SYSTEMS, *scenes, **changes) -> CubeStream:
    return CubeStream(systems, *scenes, **{"size": 6, "epoch_size": 22, "seed": 3, "threads": 1} | changes)


def loader(dataset, workers, **changes) -> DataLoader:
    # threads of the tests' own process (codecs, torch) do not live on in a forked worker
    context = ("fork" if sys.platform == "linux" else "spawn") if workers else None
    return DataLoader(dataset, num_workers=workers, multiprocessing_context=context, **changes)


def flat(example, prefix="") -> dict[str, torch.Tensor]:
    out = {}
    for name, value in example.items():
        out.update(flat(value, f"{name}.") if isinstance(value, dict) else {prefix + name: value})
    return out


def assert_same(first, second):
    first, second = flat(first), flat(second)
    assert list(first) == list(second)
    for name in first:
        assert first[name].dtype == second[name].dtype
        assert torch.equal(torch.nan_to_num(first[name]), torch.nan_to_num(second[name])), name


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.filterwarnings("ignore:Sparse invariant checks")  # torch's own, of a sparse tensor from a worker
@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize("settings", [{}, {"dtype": None}, {"layout": "sparse"}])
def test_batches_do_not_depend_on_workers(workers, settings):
    dataset = stream(batch_size=4, repeat=True, **settings)
    alone = list(dataset)
    assert len(alone) == len(dataset) == 6
    together = list(loader(dataset, workers, batch_size=None))
    assert len(together) == 6
    for first, second in zip(alone, together, strict=True):
        if first["counts"].is_sparse:
            assert second["counts"].is_coalesced()
            first, second = ({**example, "counts": example["counts"].to_dense()} for example in (first, second))
        assert_same(first, second)


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_single_samples_are_those_of_the_batches():
    dataset = stream(repeat=True)
    alone = list(dataset)
    assert [int(example["index"]) for example in alone] == list(range(22))
    for example in loader(dataset, 2, batch_size=None):
        assert_same(example, alone[int(example["index"])])
    batch = next(iter(stream(batch_size=4)))
    for place in range(4):
        assert_same({name: value[place] for name, value in flat(batch).items()}, flat(alone[place]))


def test_epochs_seeds_and_threads_differ_or_not_as_they_should():
    first = next(iter(stream()))
    assert_same(first, next(iter(stream(threads=2))))
    other = stream()
    other.set_epoch(1)
    for example in (next(iter(other)), next(iter(stream(seed=4)))):
        assert not torch.equal(first["counts"], example["counts"])
        assert int(example["seed"]) != int(first["seed"])
    assert_same(first, next(iter(other.__class__(SYSTEMS, size=6, seed=3))))  # without end: the same samples
    validation = stream(epoch_size=4, repeat=True)
    for epoch in (0, 2):
        validation.set_epoch(epoch)
        once, again = ([int(example["seed"]) for example in validation] for _ in range(2))
        assert once == again
    assert once[0] != int(first["seed"])


@pytest.mark.parametrize(("batch_size", "message"), [(3, "stacks the batches"), (None, "worker by worker")])
def test_a_loader_that_stacks_is_warned_of(batch_size, message):
    with pytest.warns(UserWarning, match=message):
        next(iter(loader(stream(batch_size=batch_size), 0, batch_size=2)))


def test_cube_is_that_of_the_sample():
    """What is given is what `simulate` makes of the sample's flux, system and seed."""
    dataset = stream(axes="HWT", dtype=None)
    for example in itertools.islice(iter(dataset), 8):
        stated = dataset.sample(int(example["index"]))
        cube = ml.simulate(stated.flux, stated.system, seed=stated.seed)[0]
        np.testing.assert_array_equal(example["counts"].numpy(), cube)
        np.testing.assert_array_equal(example["flux"]["signal"].numpy(), stated.flux.signal.astype(np.float32))
        assert int(example["seed"]) == stated.seed
        np.testing.assert_allclose(
            example["flux"]["delay"], stated.system.delay_ns(example["depth"].numpy().astype(float)), rtol=1e-6
        )
        assert float(example["system"]["cycles"]) == stated.system.cycles
        np.testing.assert_allclose(example["signal_level"], stated.flux.signal.mean(), rtol=1e-6)
        np.testing.assert_allclose(example["sbr"], stated.flux.signal.mean() / stated.flux.background.mean(), rtol=1e-6)


def test_flips_and_crops_turn_maps_and_cube_together():
    """A scene whose every pixel is told by its depth: crops and flips show in maps and in counts alike."""
    depth = np.arange(1.0, 101.0).reshape(10, 10) * 0.14
    scene = ml.Scene(depth, 0.5 + 0.005 * np.arange(100.0).reshape(10, 10))
    bright = SYSTEM.replace(cycles=400, pulse=ml.GaussianPulse(sigma_ns=0.05), bins=1000)
    recorded = set()
    for example in stream(bright, scene, size=(4, 5), epoch_size=40, signal=2.0, sbr=math.inf):
        place = np.rint(example["depth"].numpy() / 0.14).astype(int) - 1
        rows, columns = place // 10, place % 10
        down, right = rows[1, 0] - rows[0, 0], columns[0, 1] - columns[0, 0]
        np.testing.assert_array_equal(rows, rows[:1, :1] + down * np.arange(4)[:, None] + 0 * columns)
        np.testing.assert_array_equal(columns, columns[:1, :1] + right * np.arange(5) + 0 * rows)
        recorded.add((int(down), int(right)))
        np.testing.assert_allclose(example["reflectivity"], scene.reflectivity[rows, columns], rtol=1e-6)
        peak = (example["counts"].argmax(0).numpy() + 0.5) * bright.bin_ns
        np.testing.assert_allclose(peak, bright.delay_ns(example["depth"].numpy()), atol=3 * 0.05 + bright.bin_ns)
    assert recorded == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    for example in stream(bright, scene, size=10, epoch_size=3, flips=False):
        np.testing.assert_allclose(example["depth"], depth, rtol=1e-6)


def test_ranges():
    """Settings lie within their ranges and follow their laws (Kolmogorov-Smirnov and chi-square, 1e-4 each)."""
    dataset = CubeStream(
        SYSTEMS, size=4, signal=LogUniform(0.1, 10), sbr=Choice([1, 2.5]), depth_scale=Uniform(0.5, 2), seed=8
    )
    samples = [dataset.sample(k) for k in range(600)]
    systems = [example.system for example in samples]

    def uniform(values, low, high):
        assert min(values) >= low
        assert max(values) <= high
        assert stats.kstest(values, "uniform", (low, high - low)).pvalue > 1e-4

    uniform([math.log(example.signal_level) for example in samples], math.log(0.1) - 1e-12, math.log(10) + 1e-12)
    uniform([example.period_ns for example in systems], 80, 120)
    uniform([math.log(example.pulse.sigma_ns) for example in systems], math.log(0.2) - 1e-12, math.log(2) + 1e-12)
    assert {10 <= each.cycles <= 200 for each in systems} == {True}
    for values, allowed in (
        ([example.sbr for example in samples], {1.0, 2.5}),
        ([example.detector.dead_time_ns for example in systems], {0.0, 20.0, 150.0}),
    ):
        counts = [values.count(value) for value in sorted(allowed)]
        assert sum(counts) == 600
        assert stats.chisquare(counts).pvalue > 1e-4
    assert len({example.seed for example in samples}) == 600
    lengths = {example.scene.depth_m.max() for example in samples}
    assert len(lengths) > 500  # crops and scales differ


def test_one_range_leaves_the_others_alone():
    first, second = (CubeStream(SYSTEMS, size=4, flips=flips, seed=8) for flips in (True, False))
    for k in range(5):
        assert first.sample(k).system == second.sample(k).system
        assert first.sample(k).seed == second.sample(k).seed
        assert first.sample(k).signal_level == second.sample(k).signal_level


def test_given_scenes_all_come_before_any_again(tmp_path):
    scenes = [ml.Scene(np.full((3, 3), 1.0 + k), 1.0) for k in range(5)]
    for k, scene in enumerate(scenes):
        np.savez(tmp_path / f"{k}.npz", depth=scene.depth_m, reflectivity=scene.reflectivity)
    orders = []
    for source in (scenes, tmp_path):
        depths = [float(example["depth"][0, 0]) for example in stream(SYSTEM, source, size=None, epoch_size=10)]
        assert sorted(depths[:5]) == sorted(depths[5:]) == [1, 2, 3, 4, 5]
        assert depths[:5] != depths[5:]
        orders.append(depths)
    assert orders[0] == orders[1]


def test_arrays_are_scenes(tmp_path):
    """NumPy, PyTorch and a memory map: each map once, and the same as its Scene."""
    random = np.random.default_rng(0)
    depth, reflectivity = random.uniform(1, 9, (5, 6, 7)), random.uniform(0.1, 1, (5, 6, 7))
    np.save(tmp_path / "depth.npy", depth)
    maps = {"depth": np.load(tmp_path / "depth.npy", mmap_mode="r"), "reflectivity": torch.from_numpy(reflectivity)}
    scenes = [ml.Scene(*example) for example in zip(depth, reflectivity, strict=True)]
    for first, second in zip(stream(SYSTEM, maps, epoch_size=10), stream(SYSTEM, scenes, epoch_size=10), strict=True):
        assert_same(first, second)
    whole = [example["depth"] for example in stream(SYSTEM, depth, size=None, flips=False, epoch_size=5)]
    assert sorted(float(example[0, 0]) for example in whole) == sorted(depth[:, 0, 0].astype(np.float32).tolist())
    assert next(iter(stream(SYSTEM, depth[0], size=None)))["counts"].shape == (64, 6, 7)
    assert float(next(iter(stream(SYSTEM, depth)))["reflectivity"].min()) == 1.0
    for wrong, message in (
        ({"depth": depth, "reflectivity": reflectivity[:4]}, "maps of one shape"),
        ({"depths": depth}, "maps 'depth'"),
        (depth[None], r"depth map \(n, H, W\)"),
        (-depth, "depth_m must be in"),
        ((depth, reflectivity), "dictionary of arrays"),
    ):
        refused(message, stream, SYSTEM, wrong, error=(ValueError, TypeError))


def test_scenes_of_other_workers_are_whole_or_none():
    """A scene in another's place, a torn one, and a number that does not belong to it are not taken."""
    shared = SharedScenes((5, 6))
    scenes = {number: ml.Scene.example("random", (5, 6), number) for number in (3, 67, 2**64 - 1)}
    assert shared.get(3) is None
    for number, scene in scenes.items():
        shared.put(number, scene)
        result = shared.get(number)
        np.testing.assert_array_equal(result.depth_m, scene.depth_m)
        np.testing.assert_array_equal(result.reflectivity, scene.reflectivity)
    assert shared.get(3) is None  # 67 took its place
    place = 67 % 64
    shared._heads[place, 0] = 3
    assert shared.get(3) is None
    shared._heads[place, 0] = 67
    assert shared.get(67) is not None
    shared._maps[place, 0, 2, 2] += 1e-9
    assert shared.get(67) is None
    copy = pickle.loads(pickle.dumps(shared))  # which shares nothing: no process is being started
    assert copy.get(2**64 - 1) is None
    copy.put(3, scenes[3])
    assert copy.get(3) is None


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_maps_of_a_dataset_are_scenes(tmp_path):
    """Of one that `generate` wrote: seen again by other instruments, whoever makes the cubes."""
    light = {"signal": 1.0}
    scenes = {"example": "room", "size": [6, 8], "seeds": [0, 1, 2]}
    ml.generate({"scenes": scenes, "systems": [SYSTEM.replace(bins=16)], "light": light}, tmp_path / "set.zarr")
    maps = ml.dataset.open_dataset(tmp_path / "set.zarr").maps
    dataset = stream(SYSTEMS, tmp_path / "set.zarr", epoch_size=6, flips=False, size=None, repeat=True)
    alone = list(dataset)
    depths = sorted(float(depth[0, 0]) for depth in maps["depth"][:])
    assert sorted(float(example["depth"][0, 0]) for example in alone[:3]) == pytest.approx(depths, rel=1e-6)
    for first, second in zip(alone, loader(dataset, 2, batch_size=None), strict=True):
        assert_same(first, second)


def test_bad_files_are_left_out_and_told(tmp_path):
    for k in range(3):
        np.savez(tmp_path / f"{k}.npz", depth=np.full((6, 6), 1.0 + k))
    np.savez(tmp_path / "dark.npz", depth=np.full((6, 6), np.nan))
    (tmp_path / "torn.npz").write_bytes((tmp_path / "0.npz").read_bytes()[:60])
    dataset = stream(SYSTEM, tmp_path, epoch_size=10)
    with pytest.warns(UserWarning, match="left out of the stream") as warned:
        depths = [float(example["depth"][0, 0]) for example in dataset]
    assert len(warned) == 2  # each once
    assert {"dark.npz" in str(warning.message) for warning in warned} == {True, False}
    assert set(depths) == {1.0, 2.0, 3.0}
    for k in range(3):
        (tmp_path / f"{k}.npz").unlink()
    none = pytest.raises(ValueError, match="none of the 2 files of scenes can be read")
    with pytest.warns(UserWarning, match="left out"), none:
        next(iter(stream(SYSTEM, tmp_path)))


def test_crops_find_the_only_return():
    """One pixel of 2500 in a corner: every crop holds it, at all places in turn."""
    depth = np.full((50, 50), np.nan)
    depth[49, 0] = 3.0
    depth[20, 30] = 4.0
    places = [
        np.argwhere(np.isfinite(example["depth"].numpy()))
        for example in stream(SYSTEM, depth, epoch_size=40, flips=False)
    ]
    assert {len(place) for place in places} == {1}
    assert len({tuple(place[0]) for place in places}) > 5
    refused("a scene must have a pixel with a return", next, iter(stream(SYSTEM, np.full((8, 8), np.nan))))


def test_ranks_of_torchrun(monkeypatch):
    """Told by the environment before any process group exists: else every rank would train on the same samples."""
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "2")
        assert [int(example["index"]) for example in stream(epoch_size=5)] == [rank, rank + 2]
        assert [int(example["index"]) for example in stream(epoch_size=2, rank=0, world_size=1)] == [0, 1]
    monkeypatch.delenv("RANK")
    assert len(stream(epoch_size=5)) == 5


def test_buffers_are_not_given_out_while_they_are_held():
    dataset = stream(SYSTEM, batch_size=2, epoch_size=40, repeat=True)
    held = [example["counts"][0] for example in dataset]  # a view keeps the memory
    copies = [example["counts"][0].clone() for example in dataset]
    assert len({example.data_ptr() for example in held}) == len(held)
    for first, second in zip(held, copies, strict=True):
        assert torch.equal(first, second)
    freed = {example["counts"].data_ptr() for example in dataset}
    assert len(freed) <= 6  # memory is used again


def _half(example):
    return example["counts"][:32], {"own": example["counts"].sum(), "index": example["index"]}


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize("settings", [{"batch_size": 2}, {}, {"batch_size": 2, "axes": "HWT", "dtype": None}])
def test_what_workers_pass_on_is_not_overwritten_while_it_is_held(settings):
    """Views, arrays and whole batches, of more batches than a worker has pieces of memory; and their memory comes back.

    As PyTorch sees them they are ordinary tensors, also where the loader stacks them, and after a transform.
    """
    dataset = stream(SYSTEM, epoch_size=40, repeat=True, **settings)
    held = [(example["counts"][..., :3].numpy(), example) for example in loader(dataset, 2, batch_size=None)]
    for (part, example), alone in zip(held, dataset, strict=True):
        assert type(example["counts"]) is torch.Tensor
        assert_same(example, alone)
        assert np.array_equal(part, alone["counts"][..., :3].numpy())
        example["counts"].zero_()  # it is the receiver's own
    again = [example["counts"].data_ptr() for example in loader(dataset, 1, batch_size=None)]
    assert len(set(again)) <= 6
    changed = list(loader(stream(SYSTEM, epoch_size=4, transform=_half), 1, batch_size=None))
    for (part, rest), alone in zip(changed, stream(SYSTEM, epoch_size=4), strict=True):
        assert torch.equal(part, alone["counts"][:32])
        assert float(rest["own"]) == float(alone["counts"].sum())
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "this loader puts batches together worker by worker")
        stacked = list(loader(stream(SYSTEM, epoch_size=4), 2, batch_size=2))
    assert sorted(stacked[0]["index"].tolist() + stacked[1]["index"].tolist()) == [0, 1, 2, 3]
    assert type(stacked[0]["counts"]) is torch.Tensor
    assert stacked[0]["counts"].shape == (2, 64, 6, 6)


def test_examples_are_made_ahead_in_order_and_what_fails_is_told():
    alone = list(stream(SYSTEM, epoch_size=7, ahead=0))
    for number in (1, 3):
        for first, other in zip(stream(SYSTEM, epoch_size=7, ahead=number), alone, strict=True):
            assert_same(first, other)
    made: list[int] = []

    def items():
        for k in range(9):
            made.append(k)
            if k == 4:
                raise OSError("a file is gone")
            yield k

    got = prefetched(items(), 2)
    assert [next(got) for _ in range(4)] == [0, 1, 2, 3]
    refused("a file is gone", next, got, error=OSError)
    assert made == [0, 1, 2, 3, 4]


def test_a_stream_that_is_left_makes_no_more():
    made: list[int] = []

    def items():
        for k in itertools.count():
            made.append(k)
            yield k

    got = prefetched(items(), 2)
    assert next(got) == 0
    got.close()
    number = len(made)
    assert number <= 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("mars_lidar.learn")]
    assert len(made) == number


def test_mixed_counts_and_types():
    wide = SYSTEM.replace(detector=ml.Detector(dead_time_ns=0.0))
    assert wide.histogram_dtype == np.uint32
    raw = list(stream([SYSTEM, wide], dtype=None, batch_size=4))
    assert {example["counts"].dtype for example in raw} == {torch.uint32}
    for dtype in (torch.float64, torch.float16, torch.bfloat16, torch.int32):
        for first, second in zip(raw, stream([SYSTEM, wide], dtype=dtype, batch_size=4), strict=True):
            assert second["counts"].dtype == dtype
            assert torch.equal(first["counts"].to(torch.float64), second["counts"].to(torch.float64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"epoch_size": 0}, "epoch_size must be an integer"),
        ({"batch_size": 0}, "batch_size must be an integer"),
        ({"signal": 0.0}, "signal must be above 0"),
        ({"signal": math.nan}, "signal must be a finite number"),
        ({"sbr": "high"}, "sbr must be a number, Uniform"),
        ({"signal": (0.1, 1.0)}, "signal must be a number, Uniform"),
        ({"scenes": None}, "scenes must be a name, a folder"),
        ({"device": "mps"}, "device must be 'cpu' or 'cuda'"),
        ({"layout": "csr"}, "layout must be one of"),
        ({"dtype": "float32"}, "dtype must be a torch.dtype"),
        ({"engine": "quick"}, "engine must be one of"),
        ({"rank": 1}, "rank and world_size go together"),
        ({"scenes": "nowhere"}, "scenes must be one of 'room', 'random', a folder"),
        ({"scenes": []}, "scenes must be at least one"),
        ({"systems": 3}, "systems must be a System"),
        ({"systems": [SYSTEM, SYSTEM.replace(bins=32)]}, "equally many bins"),
        ({"size": 0}, "size must be an integer"),
        ({"threads": 0}, "threads must be an integer"),
        ({"reuse": 0}, "reuse must be an integer"),
    ],
)
def test_bad_arguments(changes, message):
    refused(message, CubeStream, **{"systems": SYSTEM, "size": 6} | changes, error=(ValueError, TypeError))


def test_bad_ranges_are_told_before_any_work():
    refused("low must be at most high", Uniform, 2, 1)
    refused(r"low must be .* \(0", LogUniform, 0, 1)
    refused("sigma_ns must lie in", SystemRange, base=SYSTEM, sigma_ns=LogUniform(0.1, 1000))
    refused("dead_time_ns must be above", SystemRange, base=SYSTEM, dead_time_ns=Choice([-1.0]))
    refused("size must be at most that of every scene", next, iter(stream(SYSTEM, ml.Scene(np.ones((4, 4)), 1.0))))
    refused("without end has no length", len, CubeStream(SYSTEM), error=TypeError)
    if not torch.cuda.is_available():
        refused("device='cuda' needs", CubeStream, SYSTEM, device="cuda")
