"""Laws of the number of registrations, one a pixel, as the engines that draw it by itself need them.

One word of the pixel's own random stream makes one count, whatever the law.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.statistics.count_pmf import Pmf


@dataclass(frozen=True, eq=False)
class Streams:
    """Whose counts are drawn: pixels (P,) of `realizations` realizations from number `first` on."""

    pixel_index: NDArray[np.uint32]
    realizations: int
    first: int
    seed: int
    threads: int

    def fill(self, draw: Callable[..., None], out: IndexArray, **law: NDArray[Any]) -> None:
        """Let a function of the native core draw `out` (realizations, pixels) from `law`, its arrays by name."""
        draw(
            **{name: np.ascontiguousarray(array) for name, array in law.items()},
            pixel_index=self.pixel_index,
            first_realization=self.first,
            seed=self.seed,
            out=out,
            threads=self.threads,
        )


class CountLaws(ABC):
    """A law of the count for each of some pixels."""

    @abstractmethod
    def part(self, pixels: slice) -> CountLaws:
        """Those of some of the pixels."""

    @abstractmethod
    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""

    def draw(self, streams: Streams) -> IndexArray:
        """Counts (realizations, pixels)."""
        out = np.empty((streams.realizations, streams.pixel_index.size), np.int64)
        self.fill(streams, out)
        return out


@dataclass(frozen=True, eq=False)
class OfPixels(CountLaws):
    """Laws of one kind, whose parameters are arrays (pixels, ...): fields, named as `native` names them."""

    native: ClassVar[str]  # function of the native core that draws them

    def part(self, pixels: slice) -> Self:
        """The laws of some of the pixels."""
        return replace(self, **{name: values[pixels] for name, values in vars(self).items()})

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        from mars_lidar._base.native import _core

        streams.fill(getattr(_core, self.native), out, **vars(self))


@dataclass(frozen=True, eq=False)
class RoundedGaussian(OfPixels):
    """The count law of the MaRS paper: a normal number of given mean and variance (pixels,), rounded, at least 0."""

    mean: FloatArray
    variance: FloatArray
    native = "gaussian_counts"


@dataclass(frozen=True, eq=False)
class Poisson(OfPixels):
    """No dead time: Poisson of a given mean (pixels,)."""

    mean: FloatArray
    native = "poisson_counts"


@dataclass(frozen=True, eq=False)
class Matched(OfPixels):
    """The discrete law with four given cumulants (pixels, 4): `mars_lidar.statistics.matched`."""

    cumulants: FloatArray
    native = "matched_counts"


@dataclass(frozen=True, eq=False)
class Tabulated(CountLaws):
    """Exact laws: `law` (pixels,) points to one of some; the rest is made by `of`."""

    first: IndexArray
    offsets: IndexArray
    cumulative: FloatArray
    law: IndexArray

    @classmethod
    def of(cls, windows: Sequence[Pmf], law: IndexArray) -> Tabulated:
        """From the probabilities of each law."""
        sizes = [window.p.size for window in windows]
        sums = [np.cumsum(window.p) for window in windows]
        return cls(
            np.array([window.first for window in windows], np.int64),
            np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            np.concatenate([s / s[-1] for s in sums]),
            law,
        )

    def part(self, pixels: slice) -> Tabulated:
        """The laws of some of the pixels."""
        return Tabulated(self.first, self.offsets, self.cumulative, self.law[pixels])

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        from mars_lidar._base.native import _core

        laws = {"first": self.first, "offsets": self.offsets, "cumulative": self.cumulative}
        streams.fill(_core.tabulated_counts, out, law=self.law, **laws)


@dataclass(frozen=True, eq=False)
class PartlyReplaced(CountLaws):
    """Laws of which those of the pixels `at` (ascending) are replaced by `others`, one for each of them."""

    laws: CountLaws
    at: IndexArray
    others: CountLaws

    def part(self, pixels: slice) -> CountLaws:
        """The laws of some of the pixels."""
        start, stop = int(pixels.start), int(pixels.stop)
        low, high = (int(k) for k in np.searchsorted(self.at, (start, stop)))
        laws = self.laws.part(pixels)
        return (
            PartlyReplaced(laws, self.at[low:high] - start, self.others.part(slice(low, high))) if high > low else laws
        )

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        self.laws.fill(streams, out)
        some = replace(streams, pixel_index=np.ascontiguousarray(streams.pixel_index[self.at]))
        out[:, self.at] = self.others.draw(some)
