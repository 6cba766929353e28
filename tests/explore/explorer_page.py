"""The explorer's page in a headless browser, for tests: skipped, saying so, where there is none."""

import contextlib
import itertools
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


# Text below the contrast of WCAG AA; each combination of elements, classes and inline styles is looked at once a page.
CONTRAST = """() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const linear = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const behind = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const c = rgb(getComputedStyle(e).backgroundColor);
      if (c.length < 4 || c[3] > 0.5) return c;
    }
    return [255, 255, 255];
  };
  const names = new Map();
  const style = (e) => {  // what a rule of a style sheet can select it by: rows of tables alternate
    if (!e) return "";
    if (!names.has(e)) {
      const row = e.tagName === "TR" ? [...e.parentElement.children].indexOf(e) % 2 : "";
      names.set(e, `${style(e.parentElement)} ${e.tagName}.${e.className}[${e.getAttribute("style")}]${row}`);
    }
    return names.get(e);
  };
  const low = [], styles = new Set();
  const walker = document.createTreeWalker(document.querySelector("main"), NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const text = walker.currentNode.textContent.trim(), element = walker.currentNode.parentElement;
    if (!text || styles.has(style(element))) continue;
    const skipped = "script, style, noscript, .headerlink, .katex-mathml";
    if (element.closest(skipped) || !element.checkVisibility()) continue;
    const computed = getComputedStyle(element), box = element.getBoundingClientRect();
    const colour = rgb(computed.color);
    if (box.width < 2 || computed.visibility === "hidden" || colour[3] === 0) continue;
    styles.add(style(element));
    const [a, b] = [light(colour), light(behind(element))].sort((x, y) => y - x);
    const size = parseFloat(computed.fontSize), large = size >= 24 || (size >= 18.66 && computed.fontWeight >= 700);
    if ((a + 0.05) / (b + 0.05) < (large ? 3 : 4.5))
      low.push(`${text.slice(0, 30)}: ${computed.color} on ${behind(element)}`);
  }
  return [...new Set(low)];
}"""

FACTS = """() => ({
  scroll: Math.max(0, ...[document.documentElement, ...document.querySelectorAll(".bd-article-container")]
    .map((e) => e.scrollWidth - e.clientWidth)),
  levels: [...document.querySelectorAll("h1, h2, h3, h4")].filter((h) => h.checkVisibility())
    .map((h) => Number(h.tagName[1])),
  undescribed: [...document.images].filter((i) => !i.alt || /(^|[ /_])(plot|sphx|_images)[ _/]|\\.png$/i.test(i.alt))
    .map((i) => i.alt || i.src.split("/").pop()),
  nameless: [...document.querySelectorAll("main :is(a[href], button, input, select, iframe, [role=img])")]
    .filter((e) => e.checkVisibility() && e.type !== "hidden" && !(e.ariaLabel || e.title || e.labels?.length ||
      e.textContent.trim() || e.querySelector("img[alt], svg")))
    .map((e) => e.outerHTML.slice(0, 80)),
  repeated: [...document.querySelectorAll("main [id]")].map((e) => e.id).filter((id, k, all) => all.indexOf(id) < k),
  head: [document.documentElement.lang, document.title, document.querySelector("meta[name=viewport]")?.content],
})"""


def shortcomings(tab: Any) -> dict[str, Any]:
    """Faults of an open page by kind.

    Sideways scroll; not exactly one first heading, or a skipped level; pictures, links and fields without a name;
    contrast below WCAG AA in light or dark; repeated ids; no language, title or viewport.
    """
    facts = tab.evaluate(FACTS)
    low = []
    tab.add_style_tag(content="* { transition: none !important }")
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        tab.evaluate("(scheme) => { document.documentElement.dataset.theme = scheme }", scheme)
        low += tab.evaluate(CONTRAST)
    levels = facts["levels"]
    bad = levels.count(1) != 1 or any(b > a + 1 for a, b in itertools.pairwise(levels))
    return {
        "scroll": facts["scroll"],
        "headings": levels if bad else None,
        "alt": facts["undescribed"],
        "nameless": facts["nameless"],
        "id twice": facts["repeated"],
        "head": None if all(facts["head"]) else facts["head"],
        "contrast": low[:5],
    }


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
