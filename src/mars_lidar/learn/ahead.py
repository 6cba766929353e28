"""Items made by a background thread before they are asked for."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from typing import Any, TypeVar

T = TypeVar("T")
_WAIT_S = 0.1  # after which a thread that cannot hand on its item looks whether anybody still wants it


def ahead(items: Iterator[T], number: int) -> Iterator[T]:
    """The items of an iterator, in order, up to `number` of them made before they are asked for.

    What the iterator raises is raised here, in its place. The thread ends with the last item, or after the one it is
    making when this iterator is closed.
    """
    ready: queue.Queue[tuple[Any, BaseException | None]] = queue.Queue(number)
    closed = threading.Event()

    def hand_on(item: Any, error: BaseException | None) -> bool:
        while not closed.is_set():
            try:
                ready.put((item, error), timeout=_WAIT_S)
            except queue.Full:
                continue
            return True
        return False

    def make() -> None:
        try:
            for item in items:
                if not hand_on(item, None):
                    return
        except BaseException as error:
            hand_on(None, error)
        else:
            hand_on(None, StopIteration())

    thread = threading.Thread(target=make, name="mars_lidar.learn", daemon=True)
    thread.start()
    try:
        while True:
            item, error = ready.get()
            if isinstance(error, StopIteration):
                return
            if error is not None:
                raise error
            yield item
            del item
    finally:
        closed.set()
        thread.join()
