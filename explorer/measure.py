"""How fast the explorer's page is in headless Chromium: docs/results/explorer.md.

    python explorer/measure.py            prints the table
    python explorer/measure.py --write    writes it

Times are of the page's own clock: from the start of the navigation to the frame after the first figure with its exact
mean, and from a slider's input event to the frame after the figure that it changes. Needs the extra `browser`.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "explore"))
from explorer_page import PAGE, Page, chromium

RESULTS = PAGE.parents[3] / "docs" / "results" / "explorer.md"
LOADS, MOVES = 5, {"mean": 9, "law": 3, "band": 3}
WATCH = """
const first = () => {
    if (window.explorer?.figure.results.mean) window.firstDrawn = performance.now();
    else requestAnimationFrame(first);
};
requestAnimationFrame(first);
"""
MOVE = """async ([key, place, stage]) => {
    const slider = document.getElementById(key + "-slider"), { figure } = explorer;
    figure.results = {};
    const began = performance.now();
    slider.value = place;
    slider.dispatchEvent(new Event("input"));
    for (;;) {
        await new Promise(requestAnimationFrame);
        if (figure.results[stage]) return performance.now() - began;
    }
}"""
# Stages behind the one that is measured wait until it is; the pictures are left out.
HOLD = """(held) => {
    const engine = explorer.figure.engine;
    explorer.painter.ask = () => new Promise(() => {});
    engine.free ??= engine.ask.bind(engine);
    engine.ask = async (stage, ...rest) => {
        while (held.includes(stage) && !window.released) await new Promise((go) => setTimeout(go, 10));
        return engine.free(stage, ...rest);
    };
}"""
IDLE = """async () => {
    window.released = true;
    while (explorer.figure.busy) await new Promise((go) => setTimeout(go, 10));
    window.released = false;
}"""
ORDER = ["mean", "law", "estimate", "band"]
STATES = {
    "start of the page": {},
    "bright": {"signal": 10, "background": 1},
    "512 bins, pulse of 0.3 ns": {"bins": 512, "sigma": 0.3},
    "paralyzable": {"mode": "paralyzable"},
    "synchronous": {"mode": "synchronous"},
}
STAGES = {"mean": "dots and mean", "law": "law of the count", "band": "band"}


def row(name: str, times: list[float], processor: list[float] | None = None) -> str:
    """A line of the table."""
    work = "" if processor is None else f"{statistics.median(processor):.0f}"
    return f"| {name} | {len(times)} | {min(times):.0f} | {statistics.median(times):.0f} | {work} |"


def processor_ms(browser: Any) -> float:
    """Processor time (ms) that all threads of the browser have taken."""
    session = browser.new_browser_cdp_session()
    processes = session.send("SystemInfo.getProcessInfo")["processInfo"]
    session.detach()
    total = 0
    for process in processes:
        for task in Path(f"/proc/{process['id']}/task").glob("*/schedstat"):
            total += int(task.read_text().split()[0])
    return total / 1e6


def moves(browser: Any, page: Page, stage: str) -> tuple[list[float], list[float]]:
    """Times (ms) of changes of a slider up to a stage of the figure, and the browser's processor time for each."""
    page.tab.evaluate(HOLD, ORDER[ORDER.index(stage) + 1 :])
    times, work = [], []
    for k in range(MOVES[stage]):
        page.tab.evaluate(IDLE)
        page.tab.wait_for_timeout(200)
        before = processor_ms(browser)
        times.append(float(page.tab.evaluate(MOVE, ["dead", 20 + 2 * k, stage])))
        work.append(processor_ms(browser) - before)
    page.tab.evaluate("window.released = true")
    return times, work


def first_drawings(browser: Any) -> list[float]:
    """Times (ms) from the start of the navigation to the first figure."""
    times = []
    for _ in range(LOADS):
        context = browser.new_context()
        tab = context.new_page()
        tab.add_init_script(WATCH)
        tab.goto(PAGE.as_uri())
        while not tab.evaluate("window.firstDrawn"):
            tab.wait_for_timeout(20)
        times.append(float(tab.evaluate("firstDrawn")))
        context.close()
    return times


def main() -> None:
    """Measure, and print or write the table."""
    lines = ["| what | times | fastest (ms) | median (ms) | processor time, median (ms) |", "|---|---|---|---|---|"]
    load = os.getloadavg()[0]
    with chromium() as browser:
        version = browser.version
        lines.append(row("first drawing", first_drawings(browser)))
        page = Page(browser, PAGE.as_uri())
        for name, changes in STATES.items():
            page.set(**json.loads(page.tab.evaluate("JSON.stringify(explorer.initial)")) | {"cycles": 10000} | changes)
            for stage, told in STAGES.items():
                if stage == "band" and changes.get("mode"):
                    continue
                lines.append(row(f"a slider, {name}: {told}", *moves(browser, page, stage)))
    cores = len(os.sched_getaffinity(0))
    text = f"""# The explorer's page in a browser

Made by `python explorer/measure.py --write`: Chromium {version}, headless, {cores} processor cores on which {load:.0f}
other processes were running, the page of {PAGE.stat().st_size:,} bytes from a file. A slider changes the dead time at
10,000 laser periods, without the images of all pixels, which are drawn when it rests. Times are from the event to the
next frame; those of a later stage include the earlier stages. Where other processes share the cores, wall-clock times
exceed the work of the browser: the last column is the processor time of all its threads from the event to that frame.

{chr(10).join(lines)}
"""
    print(text)
    if "--write" in sys.argv:
        RESULTS.write_text(text)


if __name__ == "__main__":
    main()
