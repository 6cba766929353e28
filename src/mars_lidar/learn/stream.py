"""Training examples simulated as they are needed: no two alike, and the same whoever makes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from mars_lidar._base import checks
from mars_lidar._base.resample import image_size
from mars_lidar._base.threads import thread_count
from mars_lidar.engines import Engine, find_engine
from mars_lidar.instrument.system import System
from mars_lidar.io.scan import SceneFile
from mars_lidar.learn.ahead import ahead as made_ahead
from mars_lidar.learn.cubes import CubeMaker
from mars_lidar.learn.distributed import rank_of, worker_of
from mars_lidar.learn.needed import torch
from mars_lidar.learn.passes import Passes, warn_if_put_together
from mars_lidar.learn.ranges import LogUniform, Range, SystemRange, as_range, as_systems
from mars_lidar.learn.sample import Recipe, Sample, example_of
from mars_lidar.learn.scenes import as_source
from mars_lidar.scene.radiometry import AMBIENTS, ATTENUATIONS
from mars_lidar.scene.scene import Scene

_LAST = 2**62


class CubeStream(torch.utils.data.IterableDataset[dict[str, Any]]):
    """Cubes and their ground truth for a `torch.utils.data.DataLoader`, simulated as they are asked for.

    Sample k of an epoch is a function of (`seed`, epoch, k) and of the settings here, never of workers, ranks,
    threads or what came before. Ranks and workers take batches in turn; none is made twice. Give `batch_size` here
    and ``batch_size=None`` to the loader: then the batches are the same, in the same order, for any number of
    workers, and are simulated in place instead of copied together.

    An example is a dictionary, with a leading axis where `batch_size` is given: ``cube`` (T, H, W); ``depth`` (m,
    NaN without a return) and ``reflectivity`` (H, W); ``flux``, a dictionary of ``signal``, ``background`` (photons
    per period) and ``delay`` (ns) (H, W); ``system``, a dictionary of ``period_ns``, ``cycles``, ``dead_time_ns``,
    ``sigma_ns``; ``signal_level``, ``sbr``, ``index``, ``seed``. Maps and settings are float32. `sample` gives the
    Scene, Flux and System themselves.

    Parameters
    ----------
    systems
        A System, several (one is drawn for each sample), or a `SystemRange`.
    scenes
        ``"random"`` (default) or ``"room"``: built-in scenes without end. A folder of RGB-D data, whatever
        `mars_lidar.io.scan` finds in it; a dataset of `mars_lidar.generate`, for its maps; Scenes and
        `mars_lidar.io.SceneFile` objects; or arrays: depths (n, H, W) in m, or a dictionary of ``depth``,
        ``reflectivity``, ``background`` (NumPy, PyTorch, or what gives one when it is indexed: memory maps, Zarr). In
        random order, each once before any comes again. A file that cannot be read, or without any return, is told by a
        warning, and the next one taken.
    size
        (H, W), or one number for a square: random crops of that size. None: 64 for built-in scenes, else scenes as
        they are.
    epoch_size
        Samples in an epoch; None (default): without end.
    batch_size
        Samples stacked into one example; None (default): one, without that axis.
    signal, sbr
        Mean signal photons per period over the image, and signal-to-background ratio, as `mars_lidar.Scene.flux`
        has them: a number or a range. Default: log-uniform in [0.01, 1] and in [0.1, 10].
    depth_scale
        Factor on the depth: a number or a range.
    flips
        Mirror scenes at random, up-down and left-right.
    attenuation, ambient, dark_counts_per_s
        As for `mars_lidar.Scene.flux`.
    engine
        Name or `Engine`, as for `mars_lidar.simulate`.
    device
        ``"cpu"``, or ``"cuda"`` to simulate on the GPU and leave the cubes there (in the process of the loader:
        ``num_workers=0``).
    layout
        ``"dense"``, or ``"sparse"``: coalesced COO tensors.
    axes
        ``"THW"``: time first, as a view of ``"HWT"`` (torch's channels-last memory format), so without a copy.
    dtype
        Of the cube; None: the counts as they are simulated (uint16 or uint32; int32 for sparse ones).
    reuse
        Samples for which a built-in scene serves, on average: other crops, flips, light and instruments.
    seed
        Integer in [0, 2**63).
    threads
        Of one process; default: the processors shared out among the loader's workers.
    ahead
        Examples that a background thread simulates while the last one is in use, without workers and on the CPU;
        0: none. Another process would cost a copy of every cube, this costs none.
    repeat
        False: every pass is the next epoch, as a training wants it. True: every pass is the same one, as a validation
        does.
    transform
        Called on each example; what it returns is given out.
    rank, world_size
        Of a distributed run; default: those of torch.distributed where it is initialised, else of the environment
        (RANK and WORLD_SIZE, as torchrun sets them), else 0 of 1. All ranks give equally many samples of an epoch, so
        that up to ``world_size - 1`` are left out.

    Raises
    ------
    ValueError, TypeError
        A bad argument, or settings that make no instrument at an end of their range.
    """

    def __init__(
        self,
        systems: System | Sequence[System] | SystemRange,
        scenes: str | Path | Scene | SceneFile | Sequence[Scene | SceneFile] | Mapping[str, Any] | Any = "random",
        *,
        size: int | tuple[int, int] | None = None,
        epoch_size: int | None = None,
        batch_size: int | None = None,
        signal: float | Range = LogUniform(0.01, 1.0),  # noqa: B008  (frozen)
        sbr: float | Range = LogUniform(0.1, 10.0),  # noqa: B008
        depth_scale: float | Range = 1.0,
        flips: bool = True,
        attenuation: Literal["none", "inverse_square"] = "none",
        ambient: Literal["uniform", "reflectivity", "map"] | None = None,
        dark_counts_per_s: float = 0.0,
        engine: str | Engine = "exact",
        device: str | torch.device = "cpu",
        layout: Literal["dense", "sparse"] = "dense",
        axes: Literal["THW", "HWT"] = "THW",
        dtype: torch.dtype | None = torch.float32,
        reuse: int = 16,
        seed: int = 0,
        threads: int | None = None,
        ahead: int = 1,
        repeat: bool = False,
        transform: Callable[[dict[str, Any]], Any] | None = None,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        super().__init__()
        shape = None if size is None else image_size(size if isinstance(size, tuple | list) else (size, size))
        if shape is None and isinstance(scenes, str) and scenes in Scene.example_names():
            shape = (64, 64)
        drawn = as_systems(systems)
        checks.choice("attenuation", attenuation, ATTENUATIONS)
        checks.choice("ambient", "map" if ambient is None else ambient, AMBIENTS)
        dark = checks.real("dark_counts_per_s", dark_counts_per_s, low=0.0)
        self._recipe = Recipe(
            source=as_source(scenes, shape, reuse),
            systems=drawn,
            size=shape,
            flips=bool(flips),
            signal=as_range("signal", signal),
            sbr=as_range("sbr", sbr, infinite=True),
            depth_scale=as_range("depth_scale", depth_scale),
            lit={"attenuation": attenuation, "ambient": ambient, "dark_counts_per_s": dark},
            seed=checks.integer("seed", seed, low=0, high=2**63 - 1),
        )
        self._end = _LAST if epoch_size is None else checks.integer("epoch_size", epoch_size, low=1, high=_LAST)
        self._batch = None if batch_size is None else checks.integer("batch_size", batch_size, low=1, high=2**20)
        self._threads = None if threads is None else checks.integer("threads", threads, low=1, high=1024)
        self._ahead = checks.integer("ahead", ahead, low=0, high=1024)
        self._maker = CubeMaker(find_engine(engine), drawn.corners(), device, layout, axes, dtype)
        self._transform = transform
        self._rank, self._world = rank_of(rank, world_size)
        self._repeat = bool(repeat)
        self._passes = Passes()
        self._given = self._pass_start = 0  # batches of the pass given here; in a worker, of the others before them
        self._joined: tuple[int, int, int] | None = None  # epoch, first sample, batches given: of a pass to go on with

    def __repr__(self) -> str:
        size = None if self._end == _LAST else self._end
        told = {"size": self._recipe.size, "epoch_size": size, "batch_size": self._batch}
        given = ", ".join(f"{name}={value}" for name, value in told.items() if value is not None)
        return f"CubeStream({given}, seed={self._recipe.seed}, epoch {self.epoch})"

    def set_epoch(self, epoch: int, start: int = 0) -> None:
        """Choose the epoch of the next pass, and its first sample: the one before which an earlier run stopped.

        Without it the first pass is epoch 0 and each gives the next one; with ``repeat=True`` all give the same. After
        n batches a loader has given samples up to ``n * batch_size * world_size``; from there the batches of the rest
        are those of a run that did not stop.
        """
        number = checks.integer("epoch", epoch, low=0, high=_LAST)
        self._passes.begin_at(number, checks.integer("start", start, low=0, high=self._end))
        self._given, self._pass_start, self._joined = 0, start, None

    @property
    def epoch(self) -> int:
        """Number of the pass that began last; before any, of the first."""
        first, _ = self._passes.first
        return first if self._repeat else first + max(self._passes.begun - 1, 0)

    def state_dict(self, batches: int | None = None) -> dict[str, int]:
        """Where the pass stands, for `load_state_dict`.

        torchdata's ``StatefulDataLoader`` asks for it in each of its workers, and resumes exactly with any number of
        them. The parent of a plain loader's workers does not know how far the pass has gone: they run ahead.

        Parameters
        ----------
        batches
            Examples taken from a plain loader with workers since the pass began: only the caller knows that number.
            None: counted here, without workers.

        Raises
        ------
        ValueError
            Without `batches` in the parent of workers.
        """
        _, workers, in_worker = worker_of()
        state = {"seed": self._recipe.seed, "epoch": self.epoch}
        if in_worker:
            return state | {"start": self._pass_start, "given": self._given, "workers": workers}
        if batches is None and self._passes.by_workers:
            raise ValueError(
                "batches must be given: workers of a loader made the pass, and only its caller knows how many batches "
                "were taken; or use torchdata's StatefulDataLoader, whose own state_dict knows"
            )
        given = self._given if batches is None else checks.integer("batches", batches, low=0, high=_LAST)
        start = (self._pass_start if batches is None else self._passes.start) + given * (self._batch or 1) * self._world
        return state | {"start": min(start, self._end)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on where `state_dict` was taken; the settings must be the same.

        A pass that was at its end then gives nothing more, and the one after it is the next epoch.
        """
        if state["seed"] != self._recipe.seed:
            raise ValueError(f"the state is of a stream with seed {state['seed']}, this one has {self._recipe.seed}")
        _, workers, in_worker = worker_of()
        if in_worker != ("workers" in state) or state.get("workers", workers) != workers:
            raise ValueError(
                f"the state is of a loader with {state.get('workers', 'no')} workers, this one has "
                f"{workers if in_worker else 'no'} workers"
            )
        if in_worker:
            self._passes.join(state["epoch"], state["start"])
            self._joined = state["epoch"], state["start"], state["given"]
        else:
            self.set_epoch(state["epoch"], state["start"])

    def sample(self, index: int) -> Sample:
        """Scene, Flux, System and seed of a sample of this epoch, not simulated."""
        return self._recipe.sample(self.epoch, checks.integer("index", index, low=0, high=self._end - 1))

    def __len__(self) -> int:
        """Examples of one pass on this rank, all workers together."""
        if self._end == _LAST:
            raise TypeError("a stream without end has no length; give epoch_size")
        return math.ceil((self._end - self._passes.start) // self._world / (self._batch or 1))

    def __iter__(self) -> Iterator[Any]:
        worker, workers, in_worker = worker_of()
        if in_worker and self._maker.on_gpu:
            raise ValueError("device='cuda' simulates in the process of the loader: use num_workers=0")
        warn_if_put_together(self._batch is not None)
        if self._joined is None:
            before, start = self._passes.begin(worker)
            epoch, given = self._passes.first[0] + (0 if self._repeat else before), 0
        else:
            epoch, start, given = self._joined
        self._joined, self._given, self._pass_start = None, given, start
        threads = self._threads or max(1, thread_count(None) // workers)
        examples: Iterator[tuple[int, dict[str, Any]]] = (
            (place, self._example(epoch, indices, threads))
            for place, indices in enumerate(self._batches(start))
            if place >= given and place % workers == worker
        )
        alone = self._ahead and not in_worker and not self._maker.on_gpu
        return self._given_out(made_ahead(examples, self._ahead) if alone else examples)

    def _given_out(self, examples: Iterator[tuple[int, dict[str, Any]]]) -> Iterator[Any]:
        for place, example in examples:
            self._given = place + 1
            yield example if self._transform is None else self._transform(example)
        self._passes.end()

    def _batches(self, start: int) -> Iterator[range]:
        """Samples of this rank, batch by batch: ranks take whole batches in turn, and equal parts of the last ones."""
        batch = self._batch or 1
        turn = batch * self._world
        while start + turn <= self._end:
            yield range(start + self._rank * batch, start + (self._rank + 1) * batch)
            start += turn
        part = (self._end - start) // self._world
        if part:
            yield range(start + self._rank * part, start + (self._rank + 1) * part)

    def _example(self, epoch: int, indices: range, threads: int) -> dict[str, Any]:
        samples = [self._recipe.sample(epoch, index) for index in indices]
        example = example_of(samples, self._maker.cubes(samples, threads))
        return _first(example) if self._batch is None else example


def _first(example: dict[str, Any]) -> dict[str, Any]:
    """Without the leading axis."""
    return {name: _first(one) if isinstance(one, dict) else one[0] for name, one in example.items()}
