"""The built site in a browser: what a visitor must not meet, on every page, on a telephone and on a desk."""

import gzip
import html
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "explore"))
from explorer_page import WAIT_MS, chromium, shortcomings  # noqa: E402

fcntl = pytest.importorskip("fcntl", reason="the site is built on systems with POSIX locks")
pytestmark = pytest.mark.full
SITE = Path(os.environ.get("SITE_UNDER_TEST", ROOT / "build" / "site"))
SOURCES = (
    "docs/*.md",
    "docs/*.py",
    "docs/*.mplstyle",
    "docs/_*/*",
    "docs/*/*.md",
    "examples/*/*.py",
    "examples/*/*.rst",
)
GENERATED = ("docs/api/", "docs/copied/", "docs/gallery/", "docs/lessons/")
WEIGHT = 1_000_000  # bytes of a page with all it loads, pictures aside, which have a limit of their own
PICTURES = 1_000_000


def pages_of(site: Path) -> list[str]:
    names = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    return [
        name
        for name in names
        if not name.startswith(("_static", "_modules", "explorer/")) and name not in ("search.html", "genindex.html")
    ]


@pytest.fixture(scope="module")
def site() -> Path:
    """The site of these sources: built here unless it is newer than all of them."""
    sources = [path for pattern in SOURCES for path in ROOT.glob(pattern)]
    newest = max(path.stat().st_mtime for path in sources if not str(path.relative_to(ROOT)).startswith(GENERATED))
    index = SITE / "index.html"
    SITE.parent.mkdir(parents=True, exist_ok=True)
    with open(SITE.parent / "site.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one process of the tests builds, the others wait for it
        if not index.is_file() or index.stat().st_mtime < newest:
            command = [sys.executable, "-m", "sphinx", "-W", "-q", "-E", "-b", "html", "docs", str(SITE)]
            subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"MPLBACKEND": "Agg"})
    return SITE


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def new_tab(browser: Any, **context: Any) -> Any:
    tab = browser.new_page(**context)
    tab.set_default_timeout(WAIT_MS)
    return tab


def weight(file: Path) -> int:
    """Bytes that a server sends: text compressed, as all of them do."""
    content = file.read_bytes()
    return len(gzip.compress(content)) if file.suffix in (".html", ".css", ".js", ".svg") else len(content)


@pytest.mark.full(seconds=55)
@pytest.mark.parametrize("step", [12, pytest.param(1, marks=pytest.mark.nightly)])
def test_every_page_on_a_telephone(site: Path, browser: Any, step: int):
    """390 px wide: nothing that `shortcomings` lists, no error on the console, below 1 MB except pictures and the
    explorer, no request to another host. One template makes the pages of the reference: each `step`-th of them."""
    tab = new_tab(browser, viewport={"width": 390, "height": 844})
    said: list[str] = []
    asked: list[str] = []
    tab.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    weights: dict[Path, int] = {}
    wrong: dict[str, Any] = {}
    pages = pages_of(site)
    reference = [name for name in pages if name.startswith("api/")]
    for name in sorted({*pages} - {*reference} | {*reference[::step]}):
        said.clear()
        asked.clear()
        tab.goto((site / name).as_uri(), wait_until="load")
        names = {
            unquote(url.removeprefix("file://").split("?")[0].split("#")[0]) for url in asked if url.startswith("file:")
        }
        files = [Path(each) for each in names if Path(each).is_file() and Path(each).parent.name != "explorer"]
        for file in files:
            weights.setdefault(file, weight(file))
        pictures = sum(weights[file] for file in files if file.suffix in (".png", ".gif", ".webp"))
        rest = sum(weights[file] for file in files) - pictures
        problems = shortcomings(tab) | {
            "console": list(said),
            "bytes": rest if rest >= WEIGHT else 0,
            "bytes of pictures": pictures if pictures >= PICTURES else 0,
            "elsewhere": [url for url in asked if not url.startswith(("file:", "data:", "blob:"))],
        }
        if any(problems.values()):
            wrong[name] = {key: value for key, value in problems.items() if value}
    tab.close()
    assert not wrong, "\n".join(f"{name}: {problems}" for name, problems in wrong.items())


def test_each_page_has_a_title_of_its_own(site: Path):
    """So that results of a search and tabs can be told apart."""
    titles: dict[str, list[str]] = {}
    for name in pages_of(site):
        heading = re.search(r"<h1>(.*?)<a", (site / name).read_text(), re.DOTALL)
        assert heading, name
        titles.setdefault(re.sub(r"<[^>]+>", "", heading[1]), []).append(name)
    assert not [names for names in titles.values() if len(names) > 1]


@pytest.mark.parametrize("folder", ["lessons", "gallery"])
def test_programs_print_what_their_texts_state(site: Path, folder: str):
    """The site runs them, and shows what they print."""
    programs = sorted(ROOT.glob(f"examples/{folder}/*_[0-9]*.py"))
    assert programs
    for program in programs:
        page = (site / folder / f"{program.stem}.html").read_text(encoding="utf-8")
        outputs = re.findall(r'"sphx-glr-script-out[^>]*>.*?<pre>(.*?)</pre>', page, re.DOTALL)
        printed = html.unescape(re.sub(r"<[^>]+>", "", "".join(outputs))).splitlines()
        prose = re.sub(r"\s*\n(?:# ?)?\s*", " ", program.read_text(encoding="utf-8"))
        stated = re.findall(r"print(?:s|ed is) ``([^`]+)``", prose)
        assert stated[-1] == printed[-1], program.name
        assert set(stated) <= set(printed), program.name
        assert all(re.search(r"\d|True", line) for line in stated), program.name


def test_the_header_is_one_line(site: Path, browser: Any):
    tab = new_tab(browser)
    tab.goto((site / "index.html").as_uri(), wait_until="load")
    for width in (960, 1100, 1279, 1280, 1400):
        tab.set_viewport_size({"width": width, "height": 700})
        items = ".bd-header :is(.nav-link, .search-button__button, .theme-switch-container, .secondary-toggle)"
        boxes = [item.bounding_box() for item in tab.locator(f"{items}:visible").all()]
        middles = [box["y"] + box["height"] / 2 for box in boxes]
        assert max(middles) - min(middles) < 10, width
        assert max(box["x"] + box["width"] for box in boxes) <= width
    tab.close()


@pytest.mark.parametrize("size", [(1400, 900), (1100, 900), (390, 844)], ids=str)
def test_the_figure_stays_beside_the_phrase_that_changes_it(site: Path, browser: Any, size: tuple[int, int]):
    tab = new_tab(browser, viewport={"width": size[0], "height": size[1]})
    tab.route("**/explorer/index.html*", lambda route: route.abort())  # the frame's place, not what it computes
    tab.goto((site / "seven_pictures.html").as_uri(), wait_until="load")
    for phrase in tab.locator("a[target=pixel]").all():
        phrase.evaluate("(e) => e.scrollIntoView({ block: 'end', behavior: 'instant' })")
        frame = tab.locator(".explorable-frame").bounding_box()
        assert 0 <= frame["y"] <= size[1] - min(frame["height"], 500), phrase.inner_text()
        box = phrase.bounding_box()
        assert box["y"] >= frame["y"] + frame["height"] or box["x"] < frame["x"], phrase.inner_text()
    tab.close()


def test_commands_can_be_copied(site: Path):
    """Two hyphens of an option are two hyphens."""
    text = re.sub(r"<title>.*?</title>", "", (site / "copied" / "commands.html").read_text())
    assert "–" not in text
    assert text.count("--") > 200


def test_equations_are_in_the_pages(site: Path):
    """Equations are HTML already, all could be read, and they have the numbers that the code cites."""
    for name, number in {
        "theory_exposure": 27,
        "theory_detectors": 23,
        "feedback": 5,
        "theory_exact": 5,
        "theory": 4,
    }.items():
        text = (site / f"{name}.html").read_text()
        assert f">{number}<" in text or f">({number})<" in text or f"\\tag{{{number}" in text, name
    for name in pages_of(site):
        text = (site / name).read_text()
        assert "katex-error" not in text, name
        assert not re.search(r"\\\\[(\\[]", re.sub(r"<(pre|code|annotation)\b.*?</\1>", "", text, flags=re.DOTALL)), (
            name
        )


def test_a_search_finds_lessons_before_reports(site: Path, browser: Any):
    tab = new_tab(browser)
    for words, first in {"dead+time": "lessons/lesson_3", "pile-up": "lessons/lesson_2"}.items():
        tab.goto(f"{(site / 'search.html').as_uri()}?q={words}")
        tab.wait_for_function("document.querySelectorAll('#search-results li a').length > 9")
        links = tab.evaluate(
            "[...document.querySelectorAll('#search-results li a')].map((a) => a.getAttribute('href'))"
        )
        assert links[0].startswith(first)
        assert not any(re.match(r"(results|studies|copied)/", link) for link in links[:9])
    tab.close()
