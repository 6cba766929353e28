"""The page in a browser, without a network: the package's bits, Python's values, clicks, keys, links, no complaint."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import matplotlib
import numpy as np
import pytest
from explorer_page import PAGE, Page, chromium
from numpy.typing import NDArray
from test_page import golden_of_page

import mars_lidar as ml
from mars_lidar.reconstruct import reconstruct
from mars_lidar.statistics import count_law, joint_law, mean_histogram, photons_per_bin

BASE: dict[str, Any] = {
    "signal": 1,
    "background": 0.2,
    "delay": 40,
    "sigma": 1,
    "dead": 50,
    "cycles": 10000,
    "bins": 128,
    "period": 100,
    "efficiency": 1,
    "dark": 0,
    "jitter": 0,
    "afterpulses": 0,
    "twilight": 0,
    "electronics": 0,
    "mode": "nonparalyzable",
    "start": "armed",
    "pixel": -1,
}
STATES: dict[str, dict[str, Any]] = {
    "free running": {},
    "dead time of many periods": {"dead": 133},
    "stationary start": {"dead": 70, "start": "stationary", "signal": 2},
    "paralyzable": {"mode": "paralyzable", "dead": 30, "background": 0.5},
    "paralyzable, warmed up": {"mode": "paralyzable", "dead": 130, "start": "stationary", "signal": 0.3},
    "synchronous": {"mode": "synchronous"},
    "synchronous, warmed up": {"mode": "synchronous", "dead": 120, "start": "stationary"},
    "gated": {"mode": "gated", "gateStart": 80, "gateWidth": 70},
    "no dead time": {"dead": 0, "cycles": 300},
    "light effects": {"efficiency": 0.3, "dark": 1e6},
    "jitter": {"jitter": 2, "cycles": 1000, "bins": 64},
    "bright": {"signal": 20, "background": 1, "cycles": 2000},
    "few cycles": {"cycles": 12, "bins": 32},
}


def system_of(state: dict[str, Any]) -> ml.System:
    effects: dict[str, Any] = {"detection_efficiency": state["efficiency"], "dark_count_hz": state["dark"]}
    if state["mode"] == "gated":
        effects |= {"gate_start_ns": state["gateStart"], "gate_width_ns": state["gateWidth"]}
    if state["jitter"]:
        effects["jitter"] = ml.Jitter(sigma_ns=state["jitter"])
    return ml.System(
        period_ns=state["period"],
        cycles=state["cycles"],
        bins=state["bins"],
        pulse=ml.GaussianPulse(sigma_ns=state["sigma"]),
        detector=ml.Detector(dead_time_ns=state["dead"], mode=state["mode"], **effects),
        start=state["start"],
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def page(browser: Any) -> Iterator[Page]:
    opened = Page(browser, PAGE.as_uri(), offline=True)
    yield opened
    opened.close()


def test_it_needs_no_network(page: Page):
    assert [asked for asked in page.asked if not asked.startswith(("blob:", "data:"))] == [PAGE.as_uri()]


def test_the_same_bits_in_the_browser(page: Page):
    found = {each["name"]: each["found"] for each in page.tab.evaluate("explorer.golden()")}
    assert found == golden_of_page()
    page.tab.click("#check")
    page.until("document.getElementById('golden').textContent.includes('All 8 golden cubes')")


@pytest.mark.parametrize("name", STATES)
def test_curves_are_python_s(page: Page, name: str):
    """Dots to the last bit; curves to rounding where both refine to the same grid, and to the tolerance where not."""
    told = page.set(**BASE | STATES[name])
    state = page.tab.evaluate("explorer.state")
    system, delay = system_of(state), float(state["delay"])
    light = (float(state["signal"]), float(state["background"]), system)
    flux = ml.Flux([[light[0]]], [[light[1]]], [[delay]])
    drawn = ml.simulate(flux, system, seed=state["seed"], pixel_index=[[0]])[0, 0, 0]
    assert np.array_equal(told["draw"]["counts"], drawn)
    assert told["draw"]["incident"] == pytest.approx(
        photons_per_bin(*light, bins=system.bins, delay_ns=delay), rel=1e-9, abs=1e-12
    )
    mean = mean_histogram(*light, delay_ns=delay)
    assert np.abs(np.array(told["mean"]["mean"]) - mean).max() <= 1e-6 * mean.max()
    law = count_law(*light, delay_ns=delay)
    assert told["mean"]["cumulants"] == pytest.approx([float(law.mean), float(law.variance)], rel=1e-5)
    assert distance(law, told["law"]) <= 2e-5
    if state["mode"] != "nonparalyzable" or state["dead"] == 0:
        assert told["spread"] == pytest.approx(np.sqrt(told["mean"]["mean"]))
    else:
        assert told["spread"] == pytest.approx(np.sqrt(joint_law(*light, delay_ns=delay).variance), rel=1e-3)


def distance(law: ml.CountLaw, told: dict[str, Any]) -> float:
    """Total variation between Python's law of the count and the page's."""
    low = min(int(law.support[0]), told["first"])
    both = np.zeros((2, max(int(law.support[-1]), told["first"] + len(told["p"]) - 1) - low + 1))
    both[0, int(law.support[0]) - low :][: law.pmf.size] = law.pmf
    both[1, told["first"] - low :][: len(told["p"])] = told["p"]
    return float(0.5 * np.abs(both[0] - both[1]).sum())


def test_what_has_no_law_says_so(page: Page):
    told = page.set(**BASE | {"afterpulses": 0.1, "cycles": 1000})
    assert "mean" not in told
    assert "afterpulses" in page.tab.inner_text("#notes")
    locked = page.set(**BASE | {"dead": 100.05, "signal": 30})
    assert "mean" in locked
    assert "takes too long" in page.tab.inner_text("#notes")


def scene(state: dict[str, Any]) -> tuple[ml.Flux, ml.System]:
    """The page's picture, from the same committed numbers."""
    import base64

    told = json.loads((PAGE.parents[3] / "explorer" / "src" / "scene.json").read_text())
    maps = {
        name: np.frombuffer(base64.b64decode(told[name]), "<u2").reshape(told["height"], told["width"]) for name in told
        if name not in ("height", "width")
    }  # fmt: skip
    delay = 2.0 / 0.299792458 * (maps["depth_mm"] / 1000.0)
    return ml.Flux(state["signal"] * (maps["light"] / 4096.0), state["background"], delay), system_of(state)


@pytest.fixture(scope="module")
def cube(page: Page) -> tuple[dict[str, Any], NDArray[np.uint32]]:
    page.set(**BASE | {"signal": 0.7, "cycles": 300, "bins": 100, "method": "peak", "seed": 5})
    page.tab.wait_for_timeout(600)
    drawn = page.picture()
    return page.tab.evaluate("explorer.state"), drawn


def test_the_picture_is_python_s(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]]):
    state, drawn = cube
    flux, system = scene(state)
    assert np.array_equal(drawn, ml.simulate(flux, system, seed=state["seed"])[0].reshape(drawn.shape))
    delay = page.tab.evaluate("Array.from(explorer.picture.delay)")
    peak = reconstruct(drawn, system, "peak").delay_ns / system.period_ns
    assert delay == pytest.approx(peak)


def test_the_picture_by_maximum_likelihood(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]]):
    _, drawn = cube
    page.set(method="likelihood")
    page.tab.wait_for_timeout(600)
    page.until("explorer.picture.whole")
    delay = np.array(page.tab.evaluate("Array.from(explorer.picture.delay, (x) => Number.isNaN(x) ? null : x)"), float)
    found = reconstruct(drawn, scene(page.tab.evaluate("explorer.state"))[1])
    seen = np.isfinite(delay)
    assert np.mean(seen == found.seen) > 0.998
    both = seen & found.seen
    off = np.abs((delay - found.delay_ns / 100.0 + 0.5) % 1.0 - 0.5)[both] * 100.0
    assert both.sum() > 1000
    assert np.mean(off < 1e-3) > 0.995  # ns: libm differs, and with it now and then the top that a climb ends on
    page.set(method="peak")


@pytest.mark.parametrize("place", [(12, 40), (50, 3)])
def test_a_click_shows_that_pixel(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]], place: tuple[int, int]):
    _, drawn = cube
    row, column = place
    box = page.tab.locator("#depth canvas").bounding_box()
    assert box is not None
    page.tab.locator("#depth canvas").scroll_into_view_if_needed()
    page.tab.evaluate("explorer.figure.results = {}")
    at = {"x": (column + 0.5) / 64 * box["width"], "y": (row + 0.5) / 64 * box["height"]}
    page.tab.locator("#depth canvas").click(position=at)
    told = page.drawn()
    assert page.tab.evaluate("explorer.state.pixel") == 64 * row + column
    assert np.array_equal(told["draw"]["counts"], drawn[64 * row + column])
    assert f"Pixel ({row}, {column})" in page.tab.inner_text("#which")


def test_keys_move_over_the_picture(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]]):
    _, drawn = cube
    page.set(pixel=64 * 20 + 30)
    page.tab.focus("#counts canvas")
    page.tab.evaluate("explorer.figure.results = {}")
    page.tab.keyboard.press("ArrowRight")
    page.tab.keyboard.press("ArrowDown")
    page.until("explorer.state.pixel === 64 * 21 + 31")
    assert np.array_equal(page.drawn()["draw"]["counts"], drawn[64 * 21 + 31])


def test_a_slider_by_keys(page: Page):
    before = page.tab.evaluate("explorer.state.dead")
    page.tab.focus("#dead-slider")
    page.tab.evaluate("explorer.figure.results = {}")
    page.tab.keyboard.press("ArrowRight")
    page.drawn()
    assert page.tab.evaluate("explorer.state.dead") > before
    labels = page.tab.evaluate(
        "[...document.querySelectorAll('input, select')].filter((x) => !x.labels.length && !x.ariaLabel).length"
    )
    assert labels == 0


def test_a_link_holds_the_state(browser: Any, page: Page):
    page.set(**BASE | {"mode": "gated", "gateWidth": 30, "pixel": 777, "log": 1})
    address, state = page.tab.evaluate("[location.href, explorer.state]")
    other = Page(browser, address, offline=True)
    assert other.tab.evaluate("explorer.state") == state
    other.close()
    odd = Page(browser, PAGE.as_uri() + "#signal=abc&bins=7e9&mode=odd&pixel=99999&dead=-3&nothing=1", offline=True)
    told = odd.tab.evaluate("explorer.state")
    kept = {"signal": 1, "bins": 1024, "mode": "nonparalyzable", "pixel": -1, "dead": 0}
    assert {name: told[name] for name in kept} == kept
    odd.close()


@pytest.mark.parametrize(
    "changes",
    [
        {"pixel": 700},
        {"mode": "synchronous", "start": "stationary"},
        {"mode": "gated", "gateStart": 30, "gateWidth": 40, "efficiency": 0.25, "dark": 5000},
        {"afterpulses": 0.05, "jitter": 0.3, "twilight": 2, "electronics": 60},
    ],
    ids=["pixel", "synchronous", "gated", "effects"],
)
def test_the_python_makes_the_same_figure(page: Page, changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    told = page.set(**BASE | {"cycles": 500} | changes)
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    monkeypatch.setattr(plt, "show", lambda: None)
    names: dict[str, Any] = {}
    exec(page.tab.inner_text("#python"), names)
    assert np.array_equal(told["draw"]["counts"], names["drawn"])
    assert told["draw"]["incident"] == pytest.approx(names["incident"], rel=1e-9, abs=1e-12)
    if "mean" in told:
        assert np.abs(np.array(told["mean"]["mean"]) - names["mean"]).max() <= 1e-6 * names["mean"].max()
        assert told["spread"] == pytest.approx(names["spread"], rel=1e-3)
        assert distance(names["law"], told["law"]) <= 2e-5
    else:
        assert "mean" not in names
    plt.close("all")


def test_dark_and_small(browser: Any):
    """Another colour scheme, and a telephone: everything is there, and nothing sticks out."""
    small = Page(browser, PAGE.as_uri(), offline=True, color_scheme="dark", viewport={"width": 360, "height": 740})
    width = small.tab.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert width[0] == width[1]
    colour = small.tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert max(int(part) for part in colour.strip("rgb()").split(",")) < 64
    small.close()
