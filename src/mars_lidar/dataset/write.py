"""Making one part of a dataset: simulate, encode, write. A part depends on the scenes of the store only."""

import errno
import hashlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.cached import cached_property
from mars_lidar.dataset.arrays import MAPS, sample_parts, with_zeros
from mars_lidar.dataset.scenes import Content
from mars_lidar.dataset.shard import DigestNotes, chunks_of, packer, write_shard
from mars_lidar.dataset.store import Dataset, Item
from mars_lidar.engines.simulation import simulate
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

_KEPT = 4  # cached scenes and fluxes: consecutive parts use the same ones


class Stopped(Exception):
    """Raised in a thread that makes a part when the run stops; the part is not written."""


@dataclass(frozen=True)
class Made:
    """Time spent on a part."""

    simulate_s: float
    write_s: float


@dataclass(frozen=True)
class Failed:
    """A part that could not be written in several attempts: its first file, the error's number and its text."""

    name: str
    number: int | None
    reason: str


_TRANSIENT_NAMES = (
    *("EIO", "EAGAIN", "EBUSY", "EINTR", "ETIMEDOUT", "ESTALE", "EREMOTEIO"),
    *("ECONNRESET", "ECONNABORTED", "ENETUNREACH", "EHOSTUNREACH"),
)
TRANSIENT = frozenset(getattr(errno, name) for name in _TRANSIENT_NAMES if hasattr(errno, name))  # not all everywhere
"""Errors of a shared file system that are often gone at the next attempt; a full disk, say, is not among them."""


class Maker:
    """Makes parts of one dataset, in one thread at a time, with a buffer of one chunk."""

    def __init__(self, dataset: Dataset, threads: int = 1, stop: threading.Event | None = None) -> None:
        self.dataset = dataset
        self._threads = threads
        self._stop = stop
        self._buffer: NDArray[Any] | None = None
        self._simulate_s = 0.0
        self._scene = lru_cache(_KEPT)(lambda number: dataset.scenes.read(number))
        self.flux = lru_cache(_KEPT)(self._lit)  # photons of a sample
        self._last: tuple[tuple[int, ...], Flux] | None = None
        self.notes = DigestNotes(dataset.path)

    def attempt(self, item: Item, pauses_s: Sequence[float] = (0.2, 1.0, 5.0)) -> Made | Failed:
        """`make`, repeated after pauses if the file system fails temporarily; other errors are raised."""
        for pause in (*pauses_s, None):
            try:
                return self.make(item)
            except OSError as error:
                if error.errno not in TRANSIENT:
                    raise
                if pause is None:
                    return Failed(self.dataset.names(item)[0], error.errno, error.strerror or str(error))
                time.sleep(pause)
        raise AssertionError("the last attempt returns")

    def make(self, item: Item) -> Made:
        """Make a part and write it."""
        began = time.perf_counter()
        if item.kind == "maps":
            for name, values in self.maps(item.region[0]).items():
                with_zeros(self.dataset.group[name])[item.region] = values
            for path in self.dataset.files(item):
                self.notes.add_content(path)
            return Made(0.0, time.perf_counter() - began)
        self._simulate_s = 0.0
        (path,) = self.dataset.files(item)
        self.notes.add(path, *write_shard(path, self._packed(item)))
        return Made(self._simulate_s, time.perf_counter() - began - self._simulate_s)

    def _packed(self, item: Item) -> Iterator[bytes | None]:
        """The chunks of a shard, one after the other."""
        array = self.dataset.histogram
        regions = list(chunks_of(item.region, array.chunks, array.shards))
        if not self._waveforms:
            for region in regions:
                yield None if region is None else self._chunk(region)
            return
        # exposures of the same pixels together, for their waveforms take longer than they do; packed they are small
        made: dict[int, bytes] = {}
        places = {k: region for k, region in enumerate(regions) if region is not None}
        for k in sorted(places, key=lambda k: [places[k][axis].start for axis in (0, 2, 3, 1)]):
            made[k] = self._chunk(places[k])
        for k in range(len(regions)):
            yield made.pop(k, None)

    def _chunk(self, region: tuple[slice, ...]) -> bytes:
        """The encoded bytes of the counts of a region, padded to a whole chunk."""
        array = self.dataset.histogram
        began = time.perf_counter()
        counts = self.counts(region)
        self._simulate_s += time.perf_counter() - began
        if counts.shape != array.chunks:  # at the edge of the array: chunks are stored whole
            ends = [(0, whole - have) for whole, have in zip(array.chunks, counts.shape, strict=True)]
            counts = np.pad(counts, ends)
        return self._pack(counts)

    @cached_property
    def _pack(self) -> Callable[[NDArray[Any]], bytes]:
        return packer(self.dataset.recipe.layout, self.dataset.histogram.dtype)

    @cached_property
    def _waveforms(self) -> bool:
        return self.dataset.scenes.waveform_parts(self.dataset.recipe.systems) > 0

    def maps(self, some: slice) -> dict[str, NDArray[np.float32]]:
        """Maps of some samples (samples, H, W)."""
        rows = []
        for sample in range(some.start, some.stop):
            self._check()
            scene, flux = self.scene(sample), self.flux(sample)
            delay = self._system(sample).delay_ns(scene.depth_m)  # of waveforms the flux has none
            rows.append((scene.depth_m, scene.reflectivity, flux.signal, flux.background, delay))
        stacks = zip(MAPS, zip(*rows, strict=True), strict=True)
        return {name: np.stack(values).astype(np.float32) for name, values in stacks}

    def counts(self, region: tuple[slice, ...]) -> NDArray[Any]:
        """Counts of a region (samples, realizations, rows, columns, all bins); valid until the next call."""
        samples, realizations, rows, columns, _ = region
        recipe = self.dataset.recipe
        dtype, width = self.dataset.histogram.dtype, self.dataset.histogram.shape[3]
        out = self._room(tuple(part.stop - part.start for part in region), dtype)
        pixels = np.arange(rows.start, rows.stop)[:, None] * width + np.arange(columns.start, columns.stop)
        for k, sample in enumerate(range(samples.start, samples.stop)):
            self._check()
            system = self._system(sample)
            direct = system.histogram_dtype == dtype
            drawn = simulate(
                self._part(sample, rows, columns),
                system,
                engine=recipe.engine,
                realizations=realizations.stop - realizations.start,
                first_realization=realizations.start,
                pixel_index=pixels,
                seed=int(self.dataset.seeds[sample]),
                threads=self._threads,
                out=out[k] if direct else None,
                progress=lambda *_: self._check(),
            )
            if not direct:
                out[k] = drawn
        return out

    def _lit(self, sample: int) -> Flux:
        recipe = self.dataset.recipe
        _, system, signal, sbr = sample_parts(recipe, sample)
        return self.scene(sample).flux(recipe.systems[system], recipe.light, signal, sbr)

    def _system(self, sample: int) -> System:
        return self.dataset.recipe.systems[sample_parts(self.dataset.recipe, sample)[1]]

    def _part(self, sample: int, rows: slice, columns: slice) -> Flux:
        """Part of the flux; the last one is cached, because making waveforms takes longer than simulating them."""
        key = (sample, rows.start, rows.stop, columns.start, columns.stop)
        if self._last is None or self._last[0] != key:
            self._last = None  # frees its memory before the next is made
            self._last = key, self.flux(sample)[rows, columns]
        return self._last[1]

    def scene(self, sample: int) -> Content:
        """The scene of a sample."""
        return self._scene(sample_parts(self.dataset.recipe, sample)[0])

    def _room(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """An array of this shape in the buffer, which is reused because new memory pages take time."""
        size = int(np.prod(shape))
        if self._buffer is None or self._buffer.size < size:
            self._buffer = np.empty(size, dtype)
        return self._buffer[:size].reshape(shape)

    def _check(self) -> None:
        if self._stop is not None and self._stop.is_set():
            raise Stopped


def fingerprint() -> str:
    """Hash of a small cube of engine exact: equal on all machines on which the package draws the same bits."""
    system = System(
        period_ns=100.0, cycles=50, bins=16, pulse=GaussianPulse(sigma_ns=2.0), detector=Detector(dead_time_ns=40.0)
    )
    flux = Flux([[0.1, 1.0, 5.0, 0.0]], [[0.3, 0.1, 0.0, 2.0]], [[10.0, 50.0, 90.0, 0.0]])
    counts = simulate(flux, system, realizations=2, seed=1, threads=1)
    return hashlib.sha256(counts.astype("<u4").tobytes()).hexdigest()[:16]
