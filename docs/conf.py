"""The documentation's site: ``python -m sphinx -W -b html docs build/site`` builds it and runs the gallery."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import matplotlib.style
from sphinx.application import Sphinx

import mars_lidar

ROOT = Path(__file__).resolve().parents[1]

project = "mars-lidar"
author = "The mars-lidar authors"
copyright = "the mars-lidar authors, MIT licence"
version = release = mars_lidar.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["gallery/**/*.ipynb", "gallery/**/*.py", "gallery/**/*.json", "gallery/**/*.md5"]
templates_path = ["_templates"]
default_role = "py:obj"
suppress_warnings = ["config.cache"]  # the gallery's settings hold a function

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 4

autosummary_generate = True
autodoc_typehints = "none"  # in the signature they are longer than the text; numpydoc shows each parameter's own
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False
numpydoc_xref_param_type = False


def _style(gallery: dict[str, object], name: str) -> None:
    """The style of every picture, applied before each example."""
    matplotlib.style.use(ROOT / "docs" / "gallery.mplstyle")


sphinx_gallery_conf = {
    "examples_dirs": ["../examples/gallery"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "min_reported_time": 5,
    "abort_on_example_error": True,
    "reset_modules": ("matplotlib", _style),
    "image_srcset": [],
}

html_theme = "pydata_sphinx_theme"
html_title = f"mars-lidar {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}
html_show_sourcelink = False

# The explorer's page, as explorer/build makes it; it is committed, and in wheels.
EXPLORER = ROOT / "src" / "mars_lidar" / "explore" / "page.html"


# Pages that stand elsewhere, where the programs or the hosts of repositories look for them, and what a program says.
COPIED = ROOT / "docs" / "copied"


def _copy(source: Path, target: Path) -> None:
    def link(found: re.Match[str]) -> str:
        return f"]({os.path.relpath(source.parent / found[1], target.parent)})"

    target.parent.mkdir(parents=True, exist_ok=True)
    text = re.sub(r"\]\((?!https?:|#)([^)\s]+)\)", link, source.read_text(encoding="utf-8"))
    text = text.replace(f"]({os.path.relpath(ROOT / 'benchmarks' / 'results', target.parent)}/", "](../benchmarks/")
    target.write_text(text, encoding="utf-8")


def _commands() -> str:
    """The command line, as it describes itself."""
    import typer
    from typer.cli import get_docs_for_click

    from mars_lidar.cli import app

    command = typer.main.get_command(app)
    text = get_docs_for_click(obj=command, ctx=typer.Context(command), name="mars-lidar", title="Command line")
    return re.sub(r"\[/?(?:bold|dim)\]", "", text)


for report in ROOT.glob("benchmarks/results/*.md"):
    _copy(report, COPIED / "benchmarks" / report.name)
for name in ("CHANGELOG", "CONTRIBUTING", "CODE_OF_CONDUCT"):
    _copy(ROOT / f"{name}.md", COPIED / "project" / f"{name.lower()}.md")
COPIED.joinpath("commands.md").write_text(_commands(), encoding="utf-8")


def _link_copies(app: Sphinx, page: str, source: list[str]) -> None:
    source[0] = source[0].replace("](../benchmarks/results/", "](copied/benchmarks/")


def _take_explorer(app: Sphinx, error: Exception | None) -> None:
    if not error:
        target = Path(app.outdir) / "explorer"
        target.mkdir(exist_ok=True)
        shutil.copyfile(EXPLORER, target / "index.html")


def setup(app: Sphinx) -> None:
    """Hooks of Sphinx."""
    app.connect("source-read", _link_copies)
    app.connect("build-finished", _take_explorer)
