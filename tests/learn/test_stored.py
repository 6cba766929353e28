"""Training examples of a stored dataset: each once, in an order of their own, shared out among ranks and workers."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.learn import StoredDataset

SYSTEM = ml.System(
    period_ns=100.0, cycles=50, bins=32, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=30.0)
)


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
    return [(int(one["sample"]), int(one["realization"])) for one in examples]


EVERY = [(sample, number) for sample in range(6) for number in range(5)]


@pytest.mark.full
def test_examples_are_the_exposures(path):
    stored = ml.dataset.open_dataset(path)
    dataset = StoredDataset(path, maps=["depth", "signal"], seed=3)
    examples = list(dataset)
    assert len(dataset) == 30
    assert numbers(examples) != EVERY
    assert sorted(numbers(examples)) == EVERY
    for one in examples:
        assert one["counts"].shape == (32, 6, 8)
        assert one["counts"].dtype == torch.float32
        counts = np.asarray(stored.histogram[one["sample"], one["realization"]])
        np.testing.assert_array_equal(one["counts"].permute(1, 2, 0).numpy(), counts)
        np.testing.assert_array_equal(one["signal"].numpy(), np.asarray(stored.maps["signal"][one["sample"]]))
        assert one["seed"].item() == int(stored.seeds[one["sample"]])
    numbered = {"sample", "realization", "scene", "system", "signal_level", "sbr", "seed"}
    assert set(examples[0]) == {"counts", "depth", "signal"} | numbered


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
        told = {}
        for batch in DataLoader(train, batch_size=2):
            assert batch["counts"].shape == (2, 32, 4, 5)
            told |= dict(zip(batch["sample"].tolist(), batch["seed"].tolist(), strict=True))
        assert told == dict(enumerate(stored.seeds.tolist()))


@pytest.mark.full
def test_orders(path):
    first, again = (StoredDataset(path, seed=1) for _ in range(2))
    one, two = numbers(first), numbers(first)
    assert one != two
    assert numbers(again) == one
    again.set_epoch(1)
    assert numbers(again) == two
    assert numbers(StoredDataset(path, shuffle=False)) == EVERY
    assert numbers(StoredDataset(path, seed=2)) != one


@pytest.mark.full
@pytest.mark.parametrize("world", [1, 2, 4, 7])
def test_ranks_have_equally_many_and_none_twice(path, world):
    parts = [numbers(StoredDataset(path, rank=rank, world_size=world, pool=2)) for rank in range(world)]
    assert {len(part) for part in parts} == {30 // world}
    together = [one for part in parts for one in part]
    assert len(set(together)) == len(together) == 30 // world * world


def test_some_samples_with_workers_of_a_loader(path):
    dataset = StoredDataset(path, samples=[5, 1, 2], axes="HWT", dtype=torch.int32, seed=4)
    with torch.random.fork_rng():
        batches = list(DataLoader(dataset, batch_size=4, num_workers=2))
    assert batches[0]["counts"].shape == (4, 6, 8, 32)
    assert batches[0]["counts"].dtype == torch.int32
    found = sorted((int(s), int(r)) for b in batches for s, r in zip(b["sample"], b["realization"], strict=True))
    assert found == [one for one in EVERY if one[0] in (1, 2, 5)]


def test_transform_and_bad_arguments(path):
    dataset = StoredDataset(path, transform=lambda one: one["counts"].sum(0), shuffle=False)
    assert next(iter(dataset)).shape == (6, 8)
    for options, error, told in (
        ({"samples": [6]}, ValueError, r"samples must lie in \[0, 6\), got 6"),
        ({"samples": []}, TypeError, "samples must be a list of integers"),
        ({"maps": ["colour"]}, ValueError, "maps must be one of"),
        ({"axes": "WHT"}, ValueError, "axes must be one of"),
        ({"rank": 1}, ValueError, "go together"),
        ({"rank": 2, "world_size": 2}, ValueError, "rank must be an integer in"),
        ({"dtype": "float"}, TypeError, "dtype must be a torch.dtype"),
        ({"pool": 0}, ValueError, "pool must be"),
    ):
        with pytest.raises(error, match=told):
            StoredDataset(path, **options)


def test_large_counts_keep_their_value():
    from mars_lidar.learn.stored import _signed

    assert _signed(np.array([40_000, 1], np.uint16)).tolist() == [40_000, 1]


def test_without_torch(monkeypatch):
    for module in ("stored", "needed"):
        monkeypatch.delitem(sys.modules, f"mars_lidar.learn.{module}")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(io.MissingLibraryError, match=r"pip install 'mars-lidar\[learn\]'"):
        from mars_lidar.learn.stored import StoredDataset  # noqa: F401
