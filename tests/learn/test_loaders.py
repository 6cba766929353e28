"""Epochs, ranks and resuming: what the stream of drawn cubes and the reader of a stored dataset have in common."""

import itertools
import pickle
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from harness import make_system, refused
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar.learn import CubeStream, StoredDataset

pytestmark = [
    pytest.mark.filterwarnings("ignore:This DataLoader will create"),
    pytest.mark.filterwarnings("ignore:'set_vital' is deprecated"),  # which torchdata calls
]
SYSTEM = make_system(30.0, 50, 32)
Make = Callable[..., Any]


@pytest.fixture(scope="module", params=["drawn", "stored"])
def make(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Makes such a dataset; several of the same settings are alike."""
    if request.param == "drawn":
        return lambda batch_size=3, **more: CubeStream(
            SYSTEM, batch_size=batch_size, **{"size": 6, "epoch_size": 22, "seed": 3, "threads": 1} | more
        )
    path = tmp_path_factory.mktemp("learn") / "set.zarr"
    scenes = {"example": "room", "size": [6, 8], "seeds": [0, 1, 2]}
    recipe = {"scenes": scenes, "systems": [SYSTEM], "light": {"signal": [0.5, 1]}, "realizations": 5}
    ml.generate(recipe | {"store": {"chunk_mib": 0.006, "shard_mib": 0.02}}, path)
    return lambda batch_size=4, **more: StoredDataset(path, batch_size=batch_size, **{"seed": 3} | more)


def content(batches: Any) -> list[list[tuple[int, ...]]]:
    """Which examples are in each batch."""
    names = ("seed", "index", "sample", "realization")
    columns = (
        [torch.as_tensor(batch[name]).reshape(-1).tolist() for name in names if name in batch] for batch in batches
    )
    return [list(zip(*each, strict=True)) for each in columns]


def loader(dataset: Any, workers: int, kind: Any = DataLoader, **changes: Any) -> Any:
    # threads of the tests' own process (codecs, torch) do not live on in a forked worker
    context = ("fork" if sys.platform == "linux" else "spawn") if workers else None
    return kind(dataset, batch_size=None, num_workers=workers, multiprocessing_context=context, **changes)


def epochs(make: Make, number: int = 5) -> list[list[list[tuple[int, ...]]]]:
    """What the first epochs give, each set by hand."""
    dataset, results = make(), []
    for epoch in range(number):
        dataset.set_epoch(epoch)
        results.append(content(dataset))
    assert len({str(each) for each in results}) == number
    assert {len(each) for each in results} == {8}
    return results


@pytest.mark.full
@pytest.mark.parametrize(("workers", "lives_on"), [(0, False), (3, False), (3, True)])
def test_epochs_advance_by_themselves(make: Make, workers: int, lives_on: bool) -> None:
    """In batches that do not depend on the workers, which take turns."""
    wanted = [sorted(each) for each in epochs(make)]
    dataset = make()
    made = loader(dataset, workers, persistent_workers=lives_on)
    assert dataset.epoch == 0
    for epoch in range(3):
        torch.manual_seed(0)  # loaders draw the seeds of their workers from it: the same in every pass
        assert sorted(content(made)) == wanted[epoch]
        assert dataset.epoch == epoch
    next(iter(made))  # one that is broken off is a pass
    if not lives_on:  # workers that live on still have it in their queues
        assert sorted(content(made)) == wanted[4]
    dataset.set_epoch(1)
    assert dataset.epoch == 1
    assert sorted(content(made)) == wanted[1]
    assert sorted(content(made)) == wanted[2]


@pytest.mark.full
@pytest.mark.parametrize(
    ("before", "after", "first", "more"), [(0, 2, 1, 3), (2, 1, 7, 1), (2, 3, 2, 2), (3, 2, 2, 5), (1, 0, 1, 2)]
)
def test_a_pass_goes_on_where_it_was_stopped(make: Make, before: int, after: int, first: int, more: int) -> None:
    """After two stops, with other numbers of workers, also where these have made all of it by then."""
    dataset = make()
    dataset.set_epoch(1)
    every = content(loader(dataset, before))
    then = content(loader(dataset, after))
    dataset = make()
    dataset.set_epoch(1)
    taken = content(itertools.islice(iter(loader(dataset, before)), first))
    second = make()
    second.load_state_dict(dataset.state_dict(first))
    going_on = iter(loader(second, after, prefetch_factor=8 if after else None))
    taken += content(itertools.islice(going_on, more))
    until = time.monotonic() + 20.0
    while after and not second._passes._shared[2] and time.monotonic() < until:
        time.sleep(0.01)
    del going_on
    third = make()
    third.load_state_dict(second.state_dict(more))
    remaining = loader(third, after)
    assert taken + content(remaining) == every
    assert sorted(content(remaining)) == sorted(then)


@pytest.mark.full
@pytest.mark.parametrize("at", [0, 4, 8], ids=["before", "within", "at the end"])
@pytest.mark.parametrize("workers", [0, 4])
def test_stateful_loaders_resume_exactly(make: Make, workers: int, at: int) -> None:
    kind = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
    whole = loader(make(), workers, kind)
    wanted = [content(whole) for _ in range(4)]
    first = loader(make(), workers, kind)
    assert content(first) == wanted[0]
    begun = iter(first)
    assert content(itertools.islice(begun, at)) == wanted[1][:at]
    if at == 8:
        assert next(begun, None) is None
    state = pickle.loads(pickle.dumps(first.state_dict()))
    del begun, first
    again = loader(make(), workers, kind)
    again.load_state_dict(state)
    if at < 8:
        assert content(again) == wanted[1][at:]
    assert [content(again), content(again)] == wanted[2:]


def test_the_parent_of_workers_does_not_know_where_they_are(make: Make) -> None:
    dataset = make()
    taken = iter(loader(dataset, 2))
    next(taken)
    refused("batches must be given", dataset.state_dict)
    state = dataset.state_dict(batches=1)
    assert (state["seed"], state["epoch"], state["start"] > 0) == (3, 0, True)
    del taken
    dataset.set_epoch(1)
    assert (dataset.state_dict()["epoch"], dataset.state_dict()["start"]) == (1, 0)
    for more, words in (({"seed": 9}, "seed 9"), ({"given_here": 1, "workers_here": 2}, "no")):
        refused(words, dataset.load_state_dict, state | more)


@pytest.mark.parametrize("world", [1, 4, 7])
@pytest.mark.parametrize("batch_size", [None, 3])
def test_ranks_have_equally_many_and_none_twice(make: Make, world: int, batch_size: int | None) -> None:
    parts = []
    for rank in range(world):
        dataset = make(batch_size, rank=rank, world_size=world)
        batches = content(dataset)
        assert len(batches) == len(dataset)
        parts.append([example for batch in batches for example in batch])
    number = len(content(make(None)))
    assert {len(part) for part in parts} == {number // world}
    assert len(set(itertools.chain(*parts))) == number // world * world
