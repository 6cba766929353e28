"""The documentation's site: ``python -m sphinx -W -b html docs build/site`` builds it and runs the gallery.

Equations become HTML while the site is built (KaTeX, run by Node): pages need neither scripts nor a network for them.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import matplotlib.style
from docutils import nodes
from sphinx.application import Sphinx
from sphinx_gallery.directives import imgsgnode

import mars_lidar

ROOT = Path(__file__).resolve().parents[1]

project = "mars-lidar"
author = "The mars-lidar authors"
version = release = mars_lidar.__version__
copyright = f"the mars-lidar authors, MIT licence; documentation of version {version}"

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = [
    "katex",
    "**/sg_execution_times.rst",
    *(f"{folder}/**/*.{kind}" for folder in ("gallery", "lessons") for kind in ("ipynb", "py", "json", "md5")),
]
templates_path = ["_templates"]
default_role = "py:obj"
smartquotes_action = "qe"  # quotes and ellipses: two hyphens are those of an option, not a dash
suppress_warnings = ["config.cache"]  # the gallery's settings hold a function

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 4
html_math_renderer = "katex"  # of this file


autosummary_generate = True
autodoc_typehints = "none"  # in the signature they are longer than the text; numpydoc shows each parameter's own
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False
numpydoc_xref_param_type = False


def _style(gallery: dict[str, object], name: str) -> None:
    """The style of every picture, applied before each example."""
    matplotlib.style.use(["mars_lidar.plot.mars", ROOT / "docs" / "gallery.mplstyle"])


sphinx_gallery_conf = {
    "examples_dirs": ["../examples/lessons", "../examples/gallery"],
    "gallery_dirs": ["lessons", "gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "min_reported_time": 5,
    "thumbnail_size": (480, 280),
    "abort_on_example_error": True,
    "reset_modules": ("matplotlib", _style),
    "image_srcset": [],
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_context = {"default_mode": "auto"}
html_title = f"mars-lidar {version}"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static", "copied/static"]
html_css_files = ["katex/katex.min.css", "site.css"]
WITH_CONTENTS = (
    "*",
    "api/*",
    "copied/*",
    "copied/*/*",
    "results/*",
    "studies/*",
)  # not the programs, which need the width
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": {pages: ["page-toc"] for pages in WITH_CONTENTS},
    "logo": {"text": project},
    "navbar_align": "left",
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}
html_show_sourcelink = False
html_search_scorer = str(ROOT / "docs" / "_static" / "scorer.js")
html_sidebars = {
    page: [] for page in ("start", "seven_pictures", "explorer", "coming_from")
}  # pages without pages below them

# Pages that stand elsewhere, where the programs or the hosts of repositories look for them, and what a program says.
COPIED = ROOT / "docs" / "copied"
COPIES = {report: COPIED / "benchmarks" / report.name for report in ROOT.glob("benchmarks/results/*.md")}
COPIES |= {ROOT / name: COPIED / "project" / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md")}


def _copy(source: Path, target: Path) -> None:
    def link(found: re.Match[str]) -> str:
        file, hash_mark, anchor = found[1].partition("#")
        meant = (source.parent / file).resolve()
        return f"]({os.path.relpath(COPIES.get(meant, meant), target.parent)}{hash_mark}{anchor})"

    target.parent.mkdir(parents=True, exist_ok=True)
    text = re.sub(r"\]\((?!https?:|#)([^)\s]+)\)", link, source.read_text(encoding="utf-8"))
    target.write_text(text, encoding="utf-8")


def _katex_style() -> None:
    """KaTeX from npm, and a copy of its style sheet and fonts for the pages."""
    package = ROOT / "docs" / "katex"
    if not (package / "node_modules" / "katex").is_dir():
        npm = shutil.which("npm")
        if npm is None:
            raise RuntimeError("building the site needs Node and npm, which render its equations: https://nodejs.org")
        subprocess.run([npm, "ci", "--silent", "--no-audit", "--no-fund"], cwd=package, check=True)
    dist, target = package / "node_modules" / "katex" / "dist", COPIED / "static" / "katex"
    shutil.rmtree(target, ignore_errors=True)
    (target / "fonts").mkdir(parents=True)
    shutil.copy(dist / "katex.min.css", target)
    for font in dist.glob("fonts/*.woff2"):
        shutil.copy(font, target / "fonts")


class Formulas:
    """Formulas as HTML, by a process of Node with KaTeX that begins with the first one."""

    process: subprocess.Popen[str] | None = None

    def html(self, tex: str, display: bool) -> str:
        """ValueError for a formula that KaTeX cannot read."""
        if self.process is None:
            command = ["node", ROOT / "docs" / "katex" / "render.js"]
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"tex": tex, "display": display}) + "\n")
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        if "error" in answer:
            raise ValueError(f"{answer['error']}: {tex}")
        return str(answer["html"])

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.communicate()
            self.process = None


FORMULAS = Formulas()


def _inline_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(f'<span class="math">{FORMULAS.html(node.astext(), display=False)}</span>')
    raise nodes.SkipNode


def _display_math(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(writer.starttag(node, "div", "", CLASS="math"))
    writer.body.append(FORMULAS.html(node.astext(), display=True) + "</div>\n")
    raise nodes.SkipNode


def _commands() -> str:
    """The command line, as it describes itself."""
    from mars_lidar.cli import app
    from mars_lidar.cli.options import describe

    describe(app)
    text = app.generate_docs(output_format="markdown").replace("# mars-lidar\n", "# Command line\n", 1)
    text = re.sub(r"(mars-lidar --install-completion).*(?= \[OPTIONS\])", r"\1", text)  # the program that runs is named
    overview, *sections = re.split(r"(?m)^(?=## mars-lidar [a-z])", text)
    commands = {name: app[name].help_epilogue for name in app}
    examples = [commands.get(section.split()[2]) for section in sections]
    parts = [example.partition("\n\n") if example else None for example in (app.help_epilogue, *examples)]
    ends = [f"```text\n{part[0]}\n```\n\n{part[2]}\n\n" if part else "" for part in parts]
    page = "".join(section + end for section, end in zip((overview, *sections), ends, strict=True))
    return re.sub(r"docs/(\w+)\.md", r"[](../\1.md)", page)


for page in (ROOT / "docs" / "api").glob("*.rst"):  # of names that have gone
    if f" {page.stem.removeprefix('mars_lidar.')}\n" not in (ROOT / "docs" / "reference.md").read_text(
        encoding="utf-8"
    ):
        page.unlink()
_katex_style()
for copied in COPIES.items():
    _copy(*copied)
COPIED.joinpath("commands.md").write_text(_commands(), encoding="utf-8")


_HEADING = re.compile(r"^(Parameters|Attributes)$")


def _annotations(thing: Any, section: str) -> dict[str, str]:
    """Types of a callable's parameters, or of a class's attributes, as the source spells them."""
    if section == "Parameters":
        try:
            parameters = inspect.signature(thing).parameters.values()
        except (TypeError, ValueError):
            return {}
        return {p.name: str(p.annotation) for p in parameters if p.annotation is not p.empty}
    types = _annotations(thing, "Parameters")
    for base in reversed(getattr(thing, "__mro__", ())):
        types |= {
            name: getattr(text, "__forward_arg__", str(text)) for name, text in inspect.get_annotations(base).items()
        }
        for name, member in vars(base).items():
            getter = getattr(member, "fget", None) or getattr(member, "func", None)  # a property, also a cached one
            text = getattr(getter, "__annotations__", {}).get("return")
            if text is not None:
                types[name] = str(text)
    return types


def _document_types(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Puts the types of the annotations beside the names of the sections Parameters and Attributes, and links pages."""
    lines[:] = [re.sub(r"docs/(\w+)\.md", r":doc:`/\1`", line) for line in lines]
    types: dict[str, str] = {}
    for number, line in enumerate(lines):
        following = lines[number + 1] if number + 1 < len(lines) else ""
        if following.startswith("---"):
            heading = _HEADING.match(line)
            types = _annotations(thing, heading[1]) if heading else {}
        elif types and re.fullmatch(r"\*{0,2}\w+(, \w+)*", line):
            of_names = [types.get(each.strip("* ")) for each in line.split(",")]
            known = list(dict.fromkeys(filter(None, of_names)))
            if len(known) == 1 or None not in of_names:  # of each name, unless all have the same
                text = known[0] if len(known) == 1 else ", ".join(map(str, of_names))
                lines[number] = f"{line} : " + re.sub(r"_(?!\w)", r"\_", text)  # not a link of reStructuredText


# Reports that one program made more than once, each with a title of its own.
TITLES = {
    "results/count_law_sequential/count_law": "Count laws against simulation photon by photon (T1)",
    "results/image": "One to ten photons a pixel, every method",
    "results/sanitize_address": "The native core under the address sanitizer",
    "results/sanitize_thread": "The native core under the thread sanitizer",
    "copied/benchmarks/default": "Benchmarks: this version",
    "copied/benchmarks/epyc": "Benchmarks: version 0.1.0",
    "copied/benchmarks/full": "Benchmarks: version 0.1.0, more cases",
}


def _title(app: Sphinx, page: str, source: list[str]) -> None:
    if page in TITLES:
        source[0] = re.sub(r"^# .*$", f"# {TITLES[page]}", source[0], count=1, flags=re.MULTILINE)


def _link_copies(app: Sphinx, page: str, source: list[str]) -> None:
    source[0] = source[0].replace("](../benchmarks/results/", "](copied/benchmarks/")
    source[0] = source[0].replace("](../CONTRIBUTING.md", "](copied/project/CONTRIBUTING.md")
    if Path(app.env.doc2path(page)).suffix == ".md":  # a page's name becomes its title
        source[0] = re.sub(r"\[[\w/]+\.md\](\((?!https?:)[^)\s]+\.md\))", r"[]\1", source[0])


_NOT_PROSE = re.compile(r"(```.*?```|(`+).*?\2|\$\$.*?\$\$|\$[^$\n]*\$|\]\([^)]*\))", re.DOTALL)
_SYMBOL = re.compile(r"(?<![\w\\./])([tN]_[dre])(?![\w/])")


def _set_symbols(app: Sphinx, page: str, source: list[str]) -> None:
    """Symbols with an index that reports, which are text, spell out."""
    if Path(app.env.doc2path(page)).suffix == ".md":
        parts = _NOT_PROSE.split(source[0])  # prose, a match, its backticks, prose, ...
        del parts[2::3]
        source[0] = "".join(part if k % 2 else _SYMBOL.sub(r"$\1$", part) for k, part in enumerate(parts))


def _describe_pictures(app: Sphinx, doctree: nodes.document) -> None:
    """Alternative texts for the pictures of the programs: else sphinx-gallery writes the name of a file."""
    if not app.env.docname.startswith(("gallery/", "lessons/")):
        return
    title = next(iter(doctree.findall(nodes.title)), nodes.title()).astext()
    pictures = [node for node in doctree.findall() if isinstance(node, (nodes.image, imgsgnode))]
    for number, image in enumerate(pictures, 1):
        description = image.get("alt", "")
        if not description or re.match(r"(plot|lesson) \d", description):
            image["alt"] = f"{title}: picture {number}, described in the text beside it"


def _wrap_pictures(app: Sphinx, doctree: nodes.document) -> None:
    """Puts pictures of programs and reports into boxes that scroll where a picture could not be read smaller."""
    if app.env.docname == "index":  # made for a phone
        return
    for image in [node for node in doctree.findall() if isinstance(node, (nodes.image, imgsgnode))]:
        if isinstance(image, imgsgnode):
            image.replace_self(nodes.container("", image.deepcopy(), classes=["picture"]))
        elif isinstance(image.parent, nodes.paragraph) and len(image.parent) == 1:
            image.parent["classes"].append("picture")


def _mark_long_cells(app: Sphinx, doctree: nodes.document) -> None:
    """Marks cells of much text, which wide tables would squeeze, and figures, which stay beside their unit."""
    for entry in doctree.findall(nodes.entry):
        text = entry.astext()
        if len(text) > 25:
            entry["classes"].append("long" if len(text) > 90 else "middling")
        elif len(text) < 14 and re.search(r"\d", text):
            entry["classes"].append("figure-cell")


def _drop_private_bases(app: Sphinx, doctree: nodes.document) -> None:
    """Removes "Bases: object" and bases that have no page of their own."""
    public = {path.stem.rsplit(".", 1)[-1] for path in (ROOT / "docs" / "api").glob("*.rst")}
    for paragraph in list(doctree.findall(nodes.paragraph)):
        label, _, bases = paragraph.astext().partition(": ")
        if label == "Bases" and not public.intersection(re.split(r"[^\w]+", bases)):
            paragraph.parent.remove(paragraph)


def _take_explorer(app: Sphinx, error: Exception | None) -> None:
    if not error:
        target = Path(app.outdir) / "explorer" / "index.html"
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(ROOT / "src" / "mars_lidar" / "explore" / "page.html", target)


def setup(app: Sphinx) -> None:
    """Hooks of Sphinx."""
    app.connect("source-read", _link_copies)
    app.connect("source-read", _title)
    app.connect("source-read", _set_symbols)
    app.connect("autodoc-process-docstring", _document_types, priority=400)  # before numpydoc, 500
    app.connect("doctree-read", _describe_pictures)
    app.connect("doctree-read", _wrap_pictures)
    app.connect("doctree-read", _drop_private_bases)
    app.connect("doctree-read", _mark_long_cells)
    app.connect("build-finished", lambda app, error: FORMULAS.close())
    app.add_html_math_renderer("katex", inline_renderers=(_inline_math, None), block_renderers=(_display_math, None))
    app.connect("build-finished", _take_explorer)
