"""Training examples of a stored dataset: each once, in an order of their own, shared out among ranks and workers."""

import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest
import torch
from harness import make_system, refused
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.learn import StoredDataset
from mars_lidar.learn.stored_dataset import Exposures

SYSTEM = make_system(30.0, 50, 32)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """6 samples x 5 realizations; chunks of two realizations."""
    recipe = {
        "scenes": {"example": "room", "size": [6, 8], "seeds": [0, 1, 2]},
        "systems": [SYSTEM],
        "light": {"signal": [0.5, 1]},
        "realizations": 5,
        "store": {"chunk_mib": 0.006, "shard_mib": 0.02},
    }
    out = tmp_path_factory.mktemp("learn") / "set.zarr"
    ml.generate(recipe, out)
    assert ml.dataset.open_dataset(out).histogram.chunks[:2] == (1, 2)
    return out


def numbers(examples) -> list[tuple[int, int]]:
    return [(int(example["sample"]), int(example["realization"])) for example in examples]


EVERY = [(sample, number) for sample in range(6) for number in range(5)]


@pytest.mark.parametrize("seed", [0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 2**64 - 1])
def test_the_documented_loop_over_any_dataset_seed(tmp_path, seed):
    """Seeds of samples fill 64 bits: half of them overflow a signed integer, so collation must not see one."""
    recipe = {
        "scenes": {"example": "room", "size": [4, 5], "seeds": [0, 1, 2, 3]},
        "systems": [SYSTEM],
        "light": {"signal": [0.5]},
        "seed": seed,
    }
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = ml.dataset.open_dataset(tmp_path / "set.zarr")
    assert stored.seeds.max() >= 2**63  # of four samples: 1 in 16 by chance, and these seeds were not chosen for it
    train = StoredDataset(tmp_path / "set.zarr", maps=["depth"], seed=1)
    for epoch in range(2):
        train.set_epoch(epoch)
        entries = {}
        for batch in DataLoader(train, batch_size=2):
            assert batch["counts"].shape == (2, 32, 4, 5)
            entries |= dict(zip(batch["sample"].tolist(), batch["seed"].tolist(), strict=True))
        assert entries == dict(enumerate(stored.seeds.tolist()))


@pytest.mark.full
def test_orders(path):
    first, again = (StoredDataset(path, seed=1) for _ in range(2))
    single, two = numbers(first), numbers(first)
    assert single != two
    assert numbers(again) == single
    again.set_epoch(1)
    assert numbers(again) == two
    assert numbers(StoredDataset(path, shuffle=False)) == EVERY
    assert numbers(StoredDataset(path, seed=2)) != single


def test_some_samples_with_workers_of_a_loader(path):
    dataset = StoredDataset(path, samples=[5, 1, 2], axes="HWT", dtype=torch.int32, seed=4)
    with torch.random.fork_rng():
        batches = list(DataLoader(dataset, batch_size=4, num_workers=2))
    assert batches[0]["counts"].shape == (4, 6, 8, 32)
    assert batches[0]["counts"].dtype == torch.int32
    result = sorted((int(s), int(r)) for b in batches for s, r in zip(b["sample"], b["realization"], strict=True))
    assert result == [example for example in EVERY if example[0] in (1, 2, 5)]


def test_transform_and_bad_arguments(path):
    dataset = StoredDataset(path, transform=lambda example: example["counts"].sum(0), shuffle=False)
    assert next(iter(dataset)).shape == (6, 8)
    for options, error, message in (
        ({"samples": [6]}, ValueError, r"samples must lie in \[0, 6\), got 6"),
        ({"samples": []}, TypeError, "samples must be a list of integers"),
        ({"maps": ["colour"]}, ValueError, "maps must be one of"),
        ({"axes": "WHT"}, ValueError, "axes must be one of"),
        ({"rank": 1}, ValueError, "go together"),
        ({"rank": 2, "world_size": 2}, ValueError, "rank must be an integer in"),
        ({"dtype": "float"}, TypeError, "dtype must be a torch.dtype"),
        ({"pool": 0}, ValueError, "pool must be"),
    ):
        refused(message, StoredDataset, path, **options, error=error)


@pytest.mark.full
@pytest.mark.parametrize("layout", ["sparse", "dense"])
@pytest.mark.parametrize(
    "store", [{"chunk_mib": 8}, {"chunk_mib": 0.006, "shard_mib": 0.02}, {"chunk_mib": 0.001, "shard_mib": 0.002}]
)
@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.int32, torch.int16, torch.uint16, torch.float64, torch.bfloat16]
)
def test_every_layout_chunk_and_type_holds_the_counts(tmp_path, layout, store, dtype):
    recipe = {
        "scenes": {"example": "room", "size": [6, 8], "seeds": [0, 1, 2]},
        "systems": [SYSTEM],
        "light": {"signal": [0.5, 1]},
        "realizations": 2,
        "store": store | {"layout": layout},
    }
    ml.generate(recipe, tmp_path / "set.zarr")
    opened = ml.dataset.open_dataset(tmp_path / "set.zarr")
    histogram, signal = np.asarray(opened.histogram), np.asarray(opened.maps["signal"])
    numbered = {"sample", "realization", "scene", "system", "signal_level", "sbr", "seed"}
    for axes in ("THW", "HWT"):
        observed = 0
        for batch in StoredDataset(
            tmp_path / "set.zarr", batch_size=5, maps=["depth", "signal"], dtype=dtype, axes=axes
        ):
            assert set(batch) == {"counts", "depth", "signal"} | numbered
            assert batch["counts"].dtype == dtype
            stored = histogram[batch["sample"], batch["realization"]]
            np.testing.assert_array_equal(batch["signal"].numpy(), signal[batch["sample"]])
            order = (0, 3, 1, 2) if axes == "THW" else (0, 1, 2, 3)
            np.testing.assert_array_equal(batch["counts"].to(torch.float64).numpy(), stored.transpose(order))
            assert batch["counts"].permute(0, 2, 3, 1).is_contiguous() == (axes == "THW")
            observed += len(stored)
        assert observed == 12


def test_a_type_that_is_too_small_is_refused(tmp_path):
    system = SYSTEM.replace(cycles=60_000, detector=ml.Detector(dead_time_ns=0.0))
    recipe = {"scenes": {"example": "room", "size": [4, 5]}, "systems": [system], "light": {"signal": [20.0]}}
    for layout in ("sparse", "dense"):
        ml.generate(recipe | {"store": {"layout": layout}}, tmp_path / "set.zarr", overwrite=True)
        assert next(iter(StoredDataset(tmp_path / "set.zarr")))["counts"].max() > 2**15
        with pytest.raises(ValueError, match=r"as torch.int16: packed counts exceed|does not hold a count of"):
            next(iter(StoredDataset(tmp_path / "set.zarr", dtype=torch.int16)))


@pytest.mark.full
def test_all_ranks_have_equally_many_batches_in_2000_random_configurations(path):
    """By batches made here and by a loader that collates; each exposure at most once, or each at least once."""
    random, dataset = np.random.default_rng(20261123), StoredDataset(path)
    stores = dataset._opened()
    for _ in range(2000):
        samples = random.choice(6, random.integers(1, 7), replace=False)
        dataset._exposures = Exposures(stores, samples)
        dataset._uneven = str(random.choice(["drop", "repeat"]))
        dataset._world = int(random.integers(1, 9))
        dataset._shuffle, dataset._pool = bool(random.random() < 0.8), int(random.integers(1, 5))
        collated, size = random.random() < 0.5, int(random.integers(1, 9))
        dataset._batch = None if collated else size
        workers, epoch = int(random.integers(1, 6)), int(random.integers(100))
        batches, given = set(), []
        for rank in range(dataset._world):
            dataset._rank = rank
            plans = [dataset._plan(epoch, 0, workers, worker, workers) for worker in range(workers)]
            number = sum(-(-len(plan) // size) if collated else len(plan) for plan in plans)
            assert sum(map(len, plans)) == len(dataset)
            batches.add(number)
            given += [int(exposure) for plan in plans for group in plan for exposure in group]
        assert len(batches) == 1
        every, remaining = dataset._exposures.number, dataset._exposures.number % dataset._world
        if dataset._uneven == "drop":
            assert len(set(given)) == len(given) == every - remaining
        else:
            assert set(given) == set(range(every))
            assert len(given) == every + (dataset._world - remaining) % dataset._world


@pytest.mark.full
def test_several_stores_as_one_dataset(path, tmp_path):
    recipe = {
        "scenes": {"example": "room", "size": [6, 8], "seeds": [7]},
        "systems": [SYSTEM.replace(cycles=70_000)],  # wider counts, other chunks and realizations
        "realizations": 2,
        "store": {"layout": "sparse"},
    }
    ml.generate(recipe, tmp_path / "more.zarr")
    dataset = StoredDataset([path, tmp_path / "more.zarr"], batch_size=4)
    results = {}
    for batch in dataset:
        for k, (store, sample) in enumerate(zip(batch["store"].tolist(), batch["sample"].tolist(), strict=True)):
            results[store, sample, int(batch["realization"][k])] = batch["counts"][k].permute(1, 2, 0).numpy()
    assert len(results) == len({key[1:] for key in results}) == 32
    for number, (where, first) in enumerate(((path, 0), (tmp_path / "more.zarr", 6))):
        stored = np.asarray(ml.dataset.open_dataset(where).histogram)
        for store, sample, realization in results:
            if store == number:
                np.testing.assert_array_equal(results[store, sample, realization], stored[sample - first, realization])
    assert {int(example["store"]) for example in StoredDataset([path, tmp_path / "more.zarr"], samples=[6])} == {1}
    recipe["scenes"]["size"] = [6, 9]
    ml.generate(recipe, tmp_path / "other.zarr")
    refused("must have the same images and bins", StoredDataset, [path, tmp_path / "other.zarr"])


_RANK = """
import sys, torch, torch.distributed as dist
from torch.utils.data import DataLoader
from mars_lidar.learn import StoredDataset
torch.set_num_threads(1)
dist.init_process_group("gloo")
model = torch.nn.parallel.DistributedDataParallel(torch.nn.Conv2d(32, 1, 1))
optimizer = torch.optim.SGD(model.parameters(), lr=1e-4)
data = StoredDataset(sys.argv[1], samples=[0, 1, 2, 3, 4], batch_size=3, seed=1)  # 25 exposures on 2 ranks
for epoch in range(3):
    numbers = []
    for batch in DataLoader(data, batch_size=None, num_workers=2):
        loss = (model(batch["counts"])[:, 0] - batch["depth"].nan_to_num()).square().mean()
        optimizer.zero_grad()
        loss.backward()  # waits for the gradients of the other rank
        optimizer.step()
        numbers += (5 * batch["sample"] + batch["realization"]).tolist()
    print(epoch, numbers)
dist.barrier()
dist.destroy_process_group()
"""


@pytest.mark.full
def test_two_ranks_train_three_epochs_on_uneven_data(path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", _RANK, str(path)],
            env=os.environ | settings | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    printed = [rank.communicate(timeout=300)[0].splitlines() for rank in ranks]
    assert [rank.returncode for rank in ranks] == [0, 0]
    epochs = []
    for first, other in zip(*printed, strict=True):
        assert first[0] == other[0]
        numbers = [json.loads(line[2:]) for line in (first, other)]
        assert [len(each) for each in numbers] == [12, 12]
        assert len({*numbers[0], *numbers[1]}) == 24
        epochs.append(tuple(numbers[0]))
    assert len(set(epochs)) == 3


def test_without_torch(monkeypatch):
    for module in ("stored_dataset", "needed"):
        monkeypatch.delitem(sys.modules, f"mars_lidar.learn.{module}")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(io.MissingLibraryError, match=r"pip install 'mars-lidar\[learn\]'"):
        from mars_lidar.learn.stored_dataset import StoredDataset  # noqa: F401
