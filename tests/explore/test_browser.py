"""The page in a browser, without a network: the package's bits, Python's values, clicks, keys, links, no complaint."""

import itertools
import json
import re
from collections.abc import Iterator
from typing import Any

import matplotlib
import numpy as np
import pytest
from explorer_page import PAGE, Page, chromium, shortcomings
from numpy.typing import NDArray
from test_page import golden_of_page

import mars_lidar as ml
from mars_lidar.reconstruction import reconstruct
from mars_lidar.statistics import count_law, joint_law, mean_histogram, photons_per_bin

pytestmark = pytest.mark.full

BASE: dict[str, Any] = {"signal": 1, "background": 0.2, "delay": 40, "sigma": 1, "dead": 50, "cycles": 10000}
BASE |= {"bins": 128, "period": 100, "second": 0, "gap": 15, "efficiency": 1, "dark": 0, "jitter": 0, "afterpulses": 0}
BASE |= {"trapDelay": 50, "twilight": 0, "electronics": 0, "seed": 1, "mode": "nonparalyzable", "start": "armed"}
BASE |= {"pixel": -1}
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
    "jitter, bright": {"jitter": 0.3, "signal": 20, "cycles": 1000, "bins": 32},
    "bright": {"signal": 20, "background": 1, "cycles": 2000},
    "few cycles": {"cycles": 12, "bins": 32},
}


def system_of(state: dict[str, Any]) -> ml.System:
    effects: dict[str, Any] = {"detection_efficiency": state["efficiency"], "dark_count_hz": state["dark"]}
    if state["mode"] == "gated":
        effects |= {"gate_start_ns": state["gateStart"], "gate_width_ns": state["gateWidth"]}
    if state["jitter"]:
        effects["jitter"] = ml.Jitter(sigma_ns=state["jitter"])
    if state["afterpulses"]:
        effects["afterpulsing"] = ml.Afterpulsing(probability=state["afterpulses"], delay_ns=state["trapDelay"])
    if state["mode"] == "nonparalyzable":
        effects["twilight_ns"] = state["twilight"]
    effects["electronics_dead_time_ns"] = state["electronics"]
    return ml.System(
        period_ns=state["period"],
        cycles=state["cycles"],
        bins=state["bins"],
        pulse=ml.GaussianPulse(sigma_ns=state["sigma"]),
        detector=ml.Detector(dead_time_ns=state["dead"], mode=state["mode"], **effects),
        start=state["start"],
    )


def flux_of(state: dict[str, Any]) -> ml.Flux:
    signal, background, delay = float(state["signal"]), float(state["background"]), float(state["delay"])
    if not state["second"]:
        return ml.Flux([[signal]], [[background]], [[delay]])
    both = [[[signal]], [[float(state["second"])]]]
    return ml.Flux(both, [[background]], [[[delay]], [[delay + state["gap"]]]])


def python_counts(state: dict[str, Any]) -> NDArray[Any]:
    return ml.simulate(flux_of(state), system_of(state), seed=state["seed"], pixel_index=[[0]])[0, 0, 0]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as process:
        yield process


@pytest.fixture(scope="module")
def page(browser: Any) -> Iterator[Page]:
    opened = Page(browser, PAGE.as_uri(), offline=True)
    yield opened
    opened.close()


def test_it_needs_no_network(page: Page):
    assert [asked for asked in page.asked if not asked.startswith(("blob:", "data:"))] == [PAGE.as_uri()]


def test_the_same_bits_in_the_browser(page: Page):
    results = {each["name"]: each["found"] for each in page.tab.evaluate("explorer.golden()")}
    assert results == golden_of_page()
    page.tab.click("#check")
    page.until("document.getElementById('golden').textContent.includes('All 8 golden cubes')")


@pytest.mark.parametrize("name", STATES)
def test_curves_are_python_s(page: Page, name: str):
    """Dots to the last bit; curves to rounding where both refine to the same grid, and to the tolerance where not."""
    answer = page.set(**BASE | STATES[name])
    state = page.tab.evaluate("explorer.state")
    system, delay = system_of(state), float(state["delay"])
    light = (ml.Flux(float(state["signal"]), float(state["background"]), delay), system)
    assert np.array_equal(answer["draw"]["counts"], python_counts(state))
    assert answer["draw"]["incident"] == pytest.approx(photons_per_bin(*light, bins=system.bins), rel=1e-9, abs=1e-12)
    mean = mean_histogram(*light)
    assert np.abs(np.array(answer["mean"]["mean"]) - mean).max() <= 1e-6 * mean.max()
    law = count_law(*light)
    assert answer["mean"]["cumulants"] == pytest.approx([float(law.mean), float(law.variance)], rel=1e-5)
    assert distance(law, answer["law"]) <= 2e-5
    if state["mode"] != "nonparalyzable":
        assert answer["spread"] is None
    elif state["dead"] == 0:
        assert answer["spread"] == pytest.approx(np.sqrt(answer["mean"]["mean"]))
    else:
        assert answer["spread"] == pytest.approx(np.sqrt(joint_law(*light).variance), rel=1e-3)


def distance(law: ml.CountLaw, answer: dict[str, Any]) -> float:
    """Total variation between Python's law of the count and the page's."""
    low = min(int(law.support[0]), answer["first"])
    both = np.zeros((2, max(int(law.support[-1]), answer["first"] + len(answer["p"]) - 1) - low + 1))
    both[0, int(law.support[0]) - low :][: law.pmf.size] = law.pmf
    both[1, answer["first"] - low :][: len(answer["p"])] = answer["p"]
    return float(0.5 * np.abs(both[0] - both[1]).sum())


def test_what_has_no_law_says_so(page: Page):
    answer = page.set(**BASE | {"afterpulses": 0.1, "cycles": 1000})
    assert "mean" not in answer
    assert "afterpulses" in page.tab.inner_text("#notes")
    locked = page.set(**BASE | {"dead": 100.05, "signal": 30})
    assert "mean" in locked
    assert "takes too long" in page.tab.inner_text("#notes")


def scene(state: dict[str, Any]) -> tuple[ml.Flux, ml.System]:
    """The page's picture, from the same committed numbers."""
    import base64

    settings = json.loads((PAGE.parents[3] / "explorer" / "src" / "scene.json").read_text())
    height, width = settings.pop("height"), settings.pop("width")
    maps = {
        name: np.frombuffer(base64.b64decode(text), "<u2").reshape(height, width) for name, text in settings.items()
    }
    delay = 2.0 / 0.299792458 * (maps["depth_mm"] / 1000.0)
    return ml.Flux(state["signal"] * (maps["light"] / 4096.0), state["background"], delay), system_of(state)


PICTURED = BASE | {"signal": 0.7, "cycles": 300, "bins": 100, "method": "peak", "seed": 5}


@pytest.fixture(scope="module")
def cube(page: Page) -> tuple[dict[str, Any], NDArray[np.uint32]]:
    page.set(**PICTURED)
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
    page.set(**PICTURED | {"method": "likelihood"})
    page.until("explorer.picture.whole")
    delay = np.array(page.tab.evaluate("Array.from(explorer.picture.delay, (x) => Number.isNaN(x) ? null : x)"), float)
    estimate = reconstruct(drawn, scene(page.tab.evaluate("explorer.state"))[1])
    estimated = np.isfinite(delay)
    assert np.mean(estimated == estimate.detected) > 0.998
    both = estimated & estimate.detected
    off = np.abs((delay - estimate.delay_ns / 100.0 + 0.5) % 1.0 - 0.5)[both] * 100.0
    assert both.sum() > 1000
    assert np.mean(off < 1e-3) > 0.995  # ns: libm differs, and with it now and then the top that a climb ends on


def test_the_picture_by_the_photons_around(page: Page):
    """Some photons a pixel, by the same native code and weights: Python's but for the rounding of logarithms."""
    given = BASE | {"signal": 0.004, "background": 0.004, "cycles": 1000, "bins": 256, "seed": 5, "method": "image"}
    page.set(**given)
    page.until("explorer.picture.whole")
    delay, half = (
        np.array(page.tab.evaluate(f"Array.from(explorer.picture.{name})"), float) for name in ("delay", "halfWidth")
    )
    flux, system = scene(page.tab.evaluate("explorer.state"))
    expected = reconstruct(page.picture().reshape(64, 64, -1), system, "image")
    off = np.abs((delay - expected.delay_ns.ravel() / 100.0 + 0.5) % 1.0 - 0.5) * 100.0
    assert np.mean(off < 1e-3) > 0.99  # ns: where two peaks are as likely, rounding decides
    stated = np.isfinite(half)
    assert np.mean(stated == np.isfinite(expected.delay_half_width_ns.ravel())) > 0.99
    both = stated & np.isfinite(expected.delay_half_width_ns.ravel())
    assert np.mean(np.abs(half * 100.0 - expected.delay_half_width_ns.ravel())[both] < 1e-3) > 0.99
    error = np.abs((delay - flux.delay_ns.ravel() / 100.0 + 0.5) % 1.0 - 0.5) * 100.0
    assert np.mean(error > 3.0 * system.pulse.sigma_ns) < 0.05  # of each pixel's fullest bin: most
    assert "fullest bin" in page.tab.inner_text("#error")


@pytest.mark.parametrize("place", [(12, 40), (50, 3)])
def test_a_click_shows_that_pixel(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]], place: tuple[int, int]):
    _, drawn = cube
    page.set(**PICTURED)
    row, column = place
    box = page.tab.locator("#depth canvas").bounding_box()
    assert box is not None
    page.tab.locator("#depth canvas").scroll_into_view_if_needed()
    page.tab.evaluate("explorer.figure.results = {}")
    at = {"x": (column + 0.5) / 64 * box["width"], "y": (row + 0.5) / 64 * box["height"]}
    page.tab.locator("#depth canvas").click(position=at)
    answer = page.drawn()
    assert page.tab.evaluate("explorer.state.pixel") == 64 * row + column
    assert np.array_equal(answer["draw"]["counts"], drawn[64 * row + column])
    assert f"Pixel ({row}, {column})" in page.tab.inner_text("#which")


def test_keys_move_over_the_picture(page: Page, cube: tuple[dict[str, Any], NDArray[np.uint32]]):
    _, drawn = cube
    page.set(**PICTURED | {"pixel": 64 * 20 + 30})
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


ADDRESS_WRITTEN = "location.href === new URL(explorer.address(), location.href).href"


def test_a_link_holds_the_state(browser: Any, page: Page):
    page.set(**BASE | {"mode": "gated", "gateWidth": 30, "pixel": 777, "log": 0})
    page.until(ADDRESS_WRITTEN)
    address, state = page.tab.evaluate("[location.href, explorer.state]")
    other = Page(browser, address, offline=True)
    assert other.tab.evaluate("explorer.state") == state
    other.close()
    odd = Page(browser, PAGE.as_uri() + "#signal=abc&bins=7e9&mode=odd&pixel=99999&dead=-3&nothing=1", offline=True)
    answer = odd.tab.evaluate("explorer.state")
    valid = {"signal": 1, "bins": 1024, "mode": "nonparalyzable", "pixel": -1, "dead": 0}
    assert {name: answer[name] for name in valid} == valid
    changed = odd.tab.inner_text("#changed")
    for words in (
        'Signal S: "abc" is not a number',
        "7000000000 became 1024",
        '"odd" is no mode',
        "pixel takes",
        "-3 became 0",
    ):
        assert words in changed
    odd.close()


@pytest.mark.parametrize(
    "changes",
    [
        {"pixel": 700},
        {"mode": "synchronous", "start": "stationary"},
        {"second": 2, "dead": 20},
        {"mode": "gated", "gateStart": 30, "gateWidth": 40, "efficiency": 0.25, "dark": 5000},
        {"afterpulses": 0.05, "jitter": 0.3, "twilight": 2, "electronics": 60},
    ],
    ids=["pixel", "synchronous", "second return", "gated", "effects"],
)
def test_the_python_makes_the_same_figure(page: Page, changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    answer = page.set(**BASE | {"cycles": 500} | changes)
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    monkeypatch.setattr(plt, "show", lambda: None)
    names: dict[str, Any] = {}
    exec(page.tab.inner_text("#python"), names)
    assert np.array_equal(answer["draw"]["counts"], names["drawn"])
    assert answer["draw"]["incident"] == pytest.approx(names["incident"], rel=1e-9, abs=1e-12)
    if "mean" in answer:
        assert np.abs(np.array(answer["mean"]["mean"]) - names["mean"]).max() <= 1e-6 * names["mean"].max()
        assert ("spread" in names) == (answer["spread"] is not None)
        assert answer["spread"] is None or answer["spread"] == pytest.approx(names["spread"], rel=1e-3)
        assert distance(names["law"], answer["law"]) <= 2e-5
    else:
        assert "mean" not in names
    plt.close("all")


def test_dark_and_small(browser: Any):
    """A telephone, in light and dark: nothing that `shortcomings` lists, and a page of less than 1 MB."""
    small = Page(browser, PAGE.as_uri(), offline=True, color_scheme="dark", viewport={"width": 360, "height": 740})
    colour = small.tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert max(int(part) for part in colour.strip("rgb()").split(",")) < 64
    problems = shortcomings(small.tab)
    assert not any(problems.values()), problems
    assert PAGE.stat().st_size < 1_000_000
    small.close()


EFFECTS: dict[str, dict[str, Any]] = {
    "none": {},
    "efficiency": {"efficiency": 0.4},
    "dark counts": {"dark": 1e6},
    "jitter": {"jitter": 1.5},
    "afterpulses": {"afterpulses": 0.1},
    "twilight": {"twilight": 3},
    "electronics": {"electronics": 90},
    "second return": {"second": 2},
}


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("mode", ["nonparalyzable", "paralyzable", "synchronous", "gated"])
def test_every_pair_of_effects_draws_python_s_bits(page: Page, mode: str, start: str):
    """Each effect alone (beside "none") and with every other, in every mode: 36 histograms, bit for bit."""
    table = {}
    for first, second in itertools.combinations_with_replacement(EFFECTS, 2):
        gate = {"gateStart": 30, "gateWidth": 40}
        state = (
            BASE
            | gate
            | {"mode": mode, "start": start, "signal": 5, "cycles": 400, "bins": 64}
            | EFFECTS[first]
            | EFFECTS[second]
        )
        counts, drawn = (
            page.tab.evaluate("(s) => explorer.counts(s).then((c) => Array.from(c))", state),
            python_counts(state),
        )
        table[first, second] = (sum(counts), int(drawn.sum()), np.array_equal(counts, drawn))
    wrong = {pair: result for pair, result in table.items() if not result[2] or result[1] == 0}
    assert not wrong, f"registrations of the page, of Python, same bits: {wrong}"


@pytest.mark.nightly
def test_random_settings_draw_python_s_bits(page: Page):
    """300 random settings with effects."""
    random = np.random.default_rng(38)
    for _ in range(300):
        state = BASE | {
            "mode": str(random.choice(["nonparalyzable", "paralyzable", "synchronous", "gated"])),
            "start": str(random.choice(["armed", "stationary"])),
            "signal": round(float(10 ** random.uniform(-2, 1.7)), 3),
            "background": round(float(10 ** random.uniform(-2, 1)), 3),
            "delay": round(float(random.uniform(0, 100)), 1),
            "dead": round(float(random.uniform(5, 250)), 1),
            "sigma": round(float(random.uniform(0.2, 4)), 2),
            "gateStart": 70,
            "gateWidth": 60,
            "cycles": int(random.integers(20, 1000)),
            "bins": int(random.choice([32, 100, 256])),
            "seed": int(random.integers(2**32)),
        }
        for effect in EFFECTS.values():
            if random.random() < 0.4:
                state |= effect
        counts = page.tab.evaluate("(s) => explorer.counts(s).then((c) => Array.from(c))", state)
        assert np.array_equal(counts, python_counts(state)), state


def test_a_slider_may_move_as_often_as_it_likes(browser: Any):
    """A browser that refuses a change of the address, as Safari does after 100 in 30 s, stops nothing."""
    counting = Page(browser, PAGE.as_uri(), offline=True)
    counting.tab.evaluate(
        "void (history.replaceState = () => { window.refused = true; throw new DOMException('', 'SecurityError'); })"
    )
    for dead in range(20, 150):
        counting.tab.evaluate("(dead) => void explorer.set({ dead })", dead)
    counting.until("window.refused")
    assert counting.set(dead=60)["state"]["dead"] == 60
    counting.close()


def test_what_cannot_be_taken_is_said(page: Page):
    page.set(**BASE | {"cycles": 200, "bins": 32})
    for key, text, value, words in [
        ("signal", "250", 100, "Signal S takes 0, or 0.001 to 100: 250 became 100."),
        ("bins", "3", 8, "Bins takes 8 to 1024, whole: 3 became 8."),
        ("cycles", "", 200, 'Laser periods: "" is not a number; it stays 200.'),
    ]:
        page.tab.fill(f"#{key}", text)
        page.tab.dispatch_event(f"#{key}", "change")
        assert page.tab.evaluate(f"explorer.state.{key}") == value
        assert page.tab.inner_text("#changed") == words
        assert page.tab.input_value(f"#{key}") == str(value)
    page.drawn()


def test_estimates_have_errors_in_units_that_fit_and_the_truth(page: Page):
    page.set(**BASE | {"signal": 5, "sigma": 0.1, "cycles": 100000, "dead": 10, "bins": 1024})
    facts = page.tab.inner_text("#facts")
    assert "True depth\n5.996 m" in facts
    assert re.search(r"5\.99\d+ m ± [\d.]+ (mm|µm), [\d.]+ (mm|µm) (long|short)", facts), facts
    page.set(**BASE | {"signal": 0, "background": 0})
    page.until("explorer.picture.whole && document.getElementById('error').textContent === 'No pixel has a depth.'")
    everything = page.tab.inner_text("body")
    assert "NaN" not in everything
    assert "no counts" in everything
    assert "law of" not in page.tab.inner_text("#notes")


def test_curves_of_another_state_are_marked(page: Page):
    """While a locked pixel computes, the law that still stands is that of the state before."""
    page.set(**BASE)
    assert not page.tab.evaluate("document.getElementById('law').classList.contains('pending')")
    page.tab.evaluate("void explorer.set({ dead: 100.05, signal: 30 })")
    computing = "document.getElementById('computing').textContent.includes('computing')"
    page.until(f"document.getElementById('law').classList.contains('pending') && {computing}")
    page.drawn()
    assert not page.tab.evaluate("document.getElementById('law').classList.contains('pending')")


def test_it_saves_what_it_shows(page: Page):
    answer = page.set(**BASE | {"bins": 32})
    rows = page.tab.evaluate("explorer.table()").splitlines()
    assert rows[1] == "time_ns,arriving_photons_mean,counts,exact_mean,standard_deviation"
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows[2:]])
    assert values[:, 2] == pytest.approx(answer["draw"]["counts"])
    assert values[:, 3] == pytest.approx(answer["mean"]["mean"])
    assert values[:, 4] == pytest.approx(answer["spread"])
    picture = page.tab.evaluate("explorer.png().then((blob) => [blob.type, blob.size])")
    assert picture[0] == "image/png"
    assert picture[1] > 10_000
    with page.tab.expect_download() as saved:
        page.tab.click("#csv")
    assert saved.value.suggested_filename == "mars-lidar.csv"


def preset(page: Page, name: str) -> dict[str, Any]:
    page.tab.evaluate("explorer.figure.results = {}")
    page.tab.click(f"#presets a:text-is('{name}')")
    page.until("!explorer.figure.busy && explorer.figure.results.whole")
    assert page.tab.get_attribute(f"#presets a:text-is('{name}')", "aria-current") == "true"
    return page.drawn()


def test_a_preset_is_taken_though_an_address_is_still_to_be_written(page: Page):
    """A link clicked within the pause after a slider's last change; the way back leads to the state before it."""
    page.set(**BASE)
    page.until(ADDRESS_WRITTEN)
    before = page.tab.evaluate("location.hash")
    taken = page.tab.evaluate(
        """() => {
            explorer.set({ signal: 7 });
            [...document.querySelectorAll("#presets a")][0].click();
            return explorer.state.signal;
        }"""
    )
    assert taken == 20
    page.tab.evaluate("new Promise((done) => void setTimeout(done, 600))")  # after every address still to be written
    assert page.tab.evaluate("explorer.state.signal") == 20
    assert page.drawn()["state"]["signal"] == 20
    page.tab.evaluate("history.back()")
    page.until(f"explorer.state.signal === {BASE['signal']}")
    assert page.tab.evaluate("location.hash") == before


def test_presets_show_what_their_sentences_say(page: Page):
    answer = preset(page, "More light, worse depth")
    assert "3.4 ns early, half a metre" in page.tab.inner_text("#story")
    crest = (np.argmax(answer["mean"]["mean"]) + 0.5) * 100 / 128
    assert 60 - crest == pytest.approx(3.4, abs=0.05)
    dimmer = page.set(signal=0.2)
    assert (np.argmax(dimmer["mean"]["mean"]) + 0.5) * 100 / 128 == pytest.approx(60, abs=0.4)
    answer = preset(page, "The echo that is not there")
    mean = np.array(answer["mean"]["mean"])
    assert "35 in the bin at 71 ns, where the end of the period has 20" in page.tab.inner_text("#story")
    assert mean[int(71 * 1.28)] == pytest.approx(35, abs=0.5)
    assert mean[-1] == pytest.approx(19.5, abs=0.6)
    assert mean[int(35 * 1.28)] < 3
    answer = preset(page, "Two surfaces become one")
    mean, time = np.array(answer["mean"]["mean"]), (np.arange(128) + 0.5) * 100 / 128
    assert "8000 photons some 35" in page.tab.inner_text("#story")
    assert mean[np.abs(time - 55) < 6].sum() == pytest.approx(35, abs=1)
    answer = preset(page, "A locked pixel counts like a clock")
    assert answer["mean"]["cumulants"][0] == pytest.approx(1000, abs=0.01)
    assert answer["mean"]["cumulants"][1] < 0.001
    answer = preset(page, "Dim light, honest errors")
    error = answer["estimate"]["likelihood"]["delayError"] * 100 * 0.299792458 / 2
    assert 0.036 < error < 0.06  # of one draw: 4.0 to 5.3 cm in nine of ten, the bound is 4.5
    assert answer["state"]["signal"] * 2000 == 60


@pytest.mark.parametrize("size", [(1400, 900), (1100, 900), (740, 360), (700, 450), (390, 844)], ids=str)
def test_nothing_is_clipped_or_covered(browser: Any, size: tuple[int, int]):
    """Wide, middling, a phone on its side, 200 % zoom, a phone: charts whole, and not under the settings."""
    small = Page(browser, PAGE.as_uri(), offline=True, viewport={"width": size[0], "height": size[1]})
    width = small.tab.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert width[0] == width[1]
    for name in ("histogram", "law"):
        chart = small.tab.locator(f"#{name}")
        inner, outer = chart.evaluate("e => [e.querySelector('.uplot').offsetWidth, e.clientWidth]")
        assert inner <= outer
    if size[1] < 700:
        assert small.tab.evaluate("getComputedStyle(document.getElementById('controls')).position") != "sticky"
    small.close()
