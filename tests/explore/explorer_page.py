"""The explorer's page in a headless browser, for tests: skipped, saying so, where there is none."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "src" / "mars_lidar" / "explore" / "page.html"
WAIT_MS = 120_000  # machines that test much else beside: nothing here is a statement about time
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium: that of Playwright, or one of the system."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs Playwright: the extra 'browser'")
    with sync_api.sync_playwright() as playwright:
        own = Path(playwright.chromium.executable_path)
        path = str(own) if own.exists() else next(filter(None, map(shutil.which, _NAMES)), None)
        if path is None:
            pytest.skip("needs a Chromium: of the system, or by `playwright install chromium`")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"], timeout=WAIT_MS)
        try:
            yield browser
        finally:
            browser.close()


class Page:
    """An open page, what it asked of the network, and what it said to the console."""

    def __init__(self, browser: Any, address: str, **context: Any) -> None:
        self.context = browser.new_context(**context)
        self.tab = self.context.new_page()
        self.asked: list[str] = []
        self.said: list[str] = []
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.on("console", lambda message: self.said.append(message.text))
        self.tab.on("pageerror", lambda error: self.said.append(str(error)))
        self.tab.set_default_timeout(WAIT_MS)
        self.tab.goto(address)
        self.drawn()

    def until(self, condition: str) -> None:
        """Wait for a condition; not by `wait_for_function`, which pages with a content policy forbid."""
        end = time.monotonic() + WAIT_MS / 1000.0
        while not self.tab.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < end, f"{condition} never came; the page said {self.said}"
            self.tab.wait_for_timeout(20)

    def drawn(self) -> dict[str, Any]:
        """The figure's results when all of its stages are there; arrays as lists."""
        self.until("window.explorer?.figure.results.whole && !explorer.figure.busy")
        return self.tab.evaluate(
            """() => JSON.parse(JSON.stringify(explorer.figure.results, (_, value) =>
                ArrayBuffer.isView(value) ? Array.from(value) : value))"""
        )

    def set(self, **changes: Any) -> dict[str, Any]:
        """`drawn` after changes of the state."""
        self.tab.evaluate("(changes) => { explorer.figure.results = {}; explorer.set(changes); }", changes)
        return self.drawn()

    def picture(self) -> NDArray[np.uint32]:
        """The cube (pixels, bins) behind the pictures, when they are drawn."""
        self.until("explorer.picture.whole")
        cube = self.tab.evaluate("explorer.pictureCube().then((cube) => Array.from(cube))")
        return np.array(cube, np.uint32).reshape(-1, self.tab.evaluate("explorer.state.bins"))

    def close(self) -> None:
        """Close it; nothing may have been said."""
        self.context.close()
        assert self.said == []
