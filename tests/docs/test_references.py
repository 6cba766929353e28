"""Names in backticks in docstrings and docs exist, and so do the pages, sections and equations that source code cites;
riddling names in the package do not come back.

A name of this package in backticks (`statistics.matched_pmf`, `System.start`, `io/cube.py`) is a reference that a
reader follows, and so is `docs/table.md, section 3`: a rename that forgets it fails here.
"""

import ast
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "mars_lidar"
PARTS = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()} | {
    path.stem for path in PACKAGE.glob("*.py")
}

DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+(?=\(|$)")
SOURCE = re.compile(r"[\w./-]+\.(?:py|h|cpp|cu|js|md|html|jinja)")
SUFFIXES = "csv|h5|incomplete|jpg|json|lock|mat|npz|pdf|pfm|png|pth|sha256|toml|txt|xxh128|yaml|zarr"
DATA = re.compile(rf"[\w./-]+\.(?:{SUFFIXES})")

# What names in the text's own examples are; and roots of names that are not this package's.
EXAMPLES = {"cube": "Cube", "flux": "Flux", "stream": "CubeStream", "system": "System", "table": "Table"}
FOREIGN = {
    *("Axes", "Figure", "ViewLayer", "dataclasses", "deepinv", "figure", "h5py", "loader", "matplotlib", "np", "numpy"),
    *("physics", "ptufile", "scipy", "spad", "sys", "systems", "tal", "torch", "xarray", "yaml", "_core"),
}
CODECS = {"mars_lidar.sparse"}  # the name of a codec in Zarr's metadata
BUILT = {"index.html", "explorer/dist/index.html"}  # by the explorer's build
PLACEHOLDERS = ("NAME", "SCENE", "FILE")

# Names that do not say what they hold, in assignments, arguments, functions and classes. The count of a folder may
# only fall: whoever removes some lowers its number here.
RIDDLES = {"found", "told", "seen", "one", "shown", "kept", "left", "mended", "elsewhere", "purse", "dear", "behind"}
MOST_RIDDLES = {"plot": 3}


@lru_cache(maxsize=1)
def _modules() -> tuple[tuple[Path, ast.Module], ...]:
    return tuple((path, ast.parse(path.read_text(encoding="utf-8"))) for path in sorted(PACKAGE.rglob("*.py")))


@lru_cache(maxsize=1)
def _files() -> tuple[str, ...]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split(
        "\n"
    )
    names = [name for name in listed if name] or [
        path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*") if path.is_file()
    ]
    return tuple("/" + name for name in names)


def _docstrings(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """(line, text) of a definition's docstring and of those of the definitions in it."""
    yield getattr(node, "lineno", 1), ast.get_docstring(node, clean=False) or ""
    for part in node.body:
        if isinstance(part, ast.ClassDef | ast.FunctionDef):
            yield from _docstrings(part)


@lru_cache(maxsize=1)
def _quoted() -> list[tuple[str, str]]:
    """(place, text in backticks) of all docstrings of the package and of all pages, but for their blocks of code."""
    texts = [
        (f"{path.relative_to(ROOT)}:{line}", text) for path, tree in _modules() for line, text in _docstrings(tree)
    ]
    generated = ("docs/api/", "docs/copied/", "docs/gallery/", "docs/lessons/", "docs/katex/node_modules/")
    for page in sorted(ROOT.glob("docs/**/*.md")):
        if page.relative_to(ROOT).as_posix().startswith(generated):
            continue
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        texts.append((str(page.relative_to(ROOT)), text))
    return [(place, quoted) for place, text in texts for quoted in re.findall(r"`([^`\n]+)`", text)]


def _top_level(tree: ast.Module) -> set[str]:
    """Names that a module defines or imports."""
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return names


def _strings(tree: ast.Module) -> set[str]:
    """Names that a module of the studies has in texts."""
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return {text for text in texts if isinstance(text, str) and text.isidentifier()}


@lru_cache(maxsize=1)
def _index() -> tuple[dict[str, set[str]], dict[str, list[ast.ClassDef]]]:
    """Names of every module by its dotted path below the package ("" for the package itself), and classes by name."""
    modules: dict[str, set[str]] = {}
    classes: dict[str, list[ast.ClassDef]] = {}
    for path, tree in _modules():
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        names = _top_level(tree)
        if (stub := path.with_suffix(".pyi")).is_file():  # of a package whose modules are imported on first use
            names |= _top_level(ast.parse(stub.read_text(encoding="utf-8")))
        modules[".".join(part for part in parts if part != "__init__")] = names
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, []).append(node)
    return modules, classes


@lru_cache
def _members(name: str) -> frozenset[str]:
    """Methods, fields and attributes of all classes of this name and of the classes that they follow from."""
    out: set[str] = set()
    for node in _index()[1].get(name, []):
        out |= {base for parent in node.bases if isinstance(parent, ast.Name) for base in _members(parent.id)}
        for part in ast.walk(node):
            if isinstance(part, ast.FunctionDef):
                out.add(part.name)
            elif isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                out.add(part.id)
            elif isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
                out.add(part.attr)
    return frozenset(out)


def _exists(dotted: str) -> bool:
    """Whether the package has a module, a name of a module or a member of a class at this path."""
    modules, classes = _index()
    names = dotted.split(".")
    names[0] = EXAMPLES.get(names[0], names[0])
    if names[0] == "studies":
        return _in_studies(names)
    if names[0] in ("ml", "mars_lidar"):
        names = names[1:]
        if names[0] == "_core":  # the compiled module
            return True
    elif names[0] not in PARTS and names[0] not in modules[""] and names[0] not in classes:
        return False
    module = ""
    while names and f"{module}.{names[0]}".strip(".") in modules:
        module, names = f"{module}.{names[0]}".strip("."), names[1:]
    if not names:
        return True
    if names[0] not in modules[module] and not (module == "" and names[0] in classes):
        return False
    return len(names) == 1 or names[0] not in classes or names[1] in _members(names[0])


def _in_studies(names: list[str]) -> bool:
    """Whether there is such a module of the studies, or such a name in one."""
    folder = ROOT
    for k, name in enumerate(names):
        file = folder / f"{name}.py"
        if (folder / name).is_dir():
            folder = folder / name
            file = folder / "__init__.py"
            if k + 1 < len(names) and ((folder / names[k + 1]).is_dir() or (folder / f"{names[k + 1]}.py").is_file()):
                continue
        rest = names[k + 1 :]
        if not (rest and file.is_file()):
            return file.is_file()
        tree = ast.parse(file.read_text(encoding="utf-8"))
        return rest[0] in _top_level(tree) | _strings(tree)
    return True


def test_dotted_names_in_backticks_exist():
    missing = []
    for place, quoted in _quoted():
        match = DOTTED.match(quoted)
        if match is None or SOURCE.fullmatch(quoted) or DATA.fullmatch(quoted) or quoted in CODECS:
            continue
        if match[0].split(".")[0] not in FOREIGN and not _exists(match[0]):
            missing.append(f"{place}: `{quoted}`")
    assert not missing, "\n".join(missing)


def test_source_files_in_backticks_exist():
    files = _files()
    missing = [
        f"{place}: `{quoted}`"
        for place, quoted in _quoted()
        if SOURCE.fullmatch(quoted)
        and quoted not in BUILT
        and not any(word in quoted for word in PLACEHOLDERS)
        and not any(name.endswith("/" + quoted.removeprefix("/")) for name in files)
    ]
    assert not missing, "\n".join(missing)


# --- Pages that source code cites ------------------------------------------------------------------------------------

PAGE = r"docs/([\w/]+)\.md"
NUMBER = r"[RPL]?\d+(?:\.\d)?[a-z]?"
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
CITED_SECTION = re.compile(rf"{PAGE},? \(?sections? (\d+(?:\.\d)?)|sections? (\d+(?:\.\d)?) of {PAGE}")
CITED_HEADING = re.compile(rf'{PAGE}, "([^"]+)"')
# Numbers of equations that cannot be anything else: (R9a), (4.3), "eq. 14" or "eq. 9, 11"; and those beside a page.
CITED_NUMBER = re.compile(rf"(?<![\w)])\(([RPL]\d+[a-z]?|\d\.\d)\)|\beq\. ({NUMBER})(?:, ({NUMBER}))?\)")
BESIDE_PAGE = re.compile(rf"{PAGE},? (?:eq\.|equations?)? ?\(?({NUMBER})\)?(?: (?:to|and) \(?({NUMBER})\)?)?(?![\w.])")
BEFORE_PAGE = re.compile(rf"(?:eq\.|equations?|\() ?({NUMBER})\)? of {PAGE}")


def _comments(path: Path) -> str:
    """All comments of a C++ or JavaScript file, or all of a Python file, as running text."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        text = "\n".join(COMMENT.findall(text))
    return re.sub(r"\s*\n\s*(?://|\*(?!\*)|#)?\s*", " ", text)


@lru_cache
def _equations(page: str) -> frozenset[str]:
    """Numbers of the equations of a page: its tags, and those that stand in its text."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return frozenset(re.findall(rf"\\tag\{{({NUMBER})\}}", text) + re.findall(r"(?<!\w)\(([RPL]\d+[a-z]?)\)", text))


@lru_cache
def _headings(page: str) -> frozenset[str]:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return frozenset(re.findall(r"^#+ +(.+?) *$", text, flags=re.MULTILINE))


def _citing() -> list[Path]:
    patterns = ("src/mars_lidar/**/*.py", "src/mars_lidar/native/**/*", "explorer/native/*", "explorer/src/*")
    kinds = (".py", ".h", ".cpp", ".cu", ".js")
    return sorted(path for each in patterns for path in ROOT.glob(each) if path.suffix in kinds)


def test_pages_and_sections_that_code_cites_exist():
    missing = []
    for path in _citing():
        text, place = _comments(path), path.relative_to(ROOT)
        pages = {page for page in re.findall(PAGE, text) if (ROOT / "docs" / f"{page}.md").is_file()}
        missing += [f"{place}: docs/{page}.md" for page in set(re.findall(PAGE, text)) - pages]
        for page, section, other_section, other_page in CITED_SECTION.findall(text):
            page, section = page or other_page, section or other_section
            if page in pages and not any(re.match(rf"{section}\.? ", heading) for heading in _headings(page)):
                missing.append(f"{place}: docs/{page}.md, section {section}")
        for page, heading in CITED_HEADING.findall(text):
            if page in pages and heading not in _headings(page):
                missing.append(f'{place}: docs/{page}.md, "{heading}"')
    assert not missing, "\n".join(missing)


def test_equations_that_native_code_cites_exist():
    """Each number of an equation is one of a page that its file cites, or its folder where the file cites none."""
    sources = {path: _comments(path) for path in _citing() if path.suffix != ".py"}
    folders: dict[Path, set[str]] = {}
    for path, text in sources.items():
        folders.setdefault(path.parent, set()).update(re.findall(PAGE, text))
    missing, resolved = [], 0
    for path, text in sources.items():
        place, pages = path.relative_to(ROOT), set(re.findall(PAGE, text)) or folders[path.parent]
        known = {number for page in pages for number in _equations(page)}
        cited = {number for match in CITED_NUMBER.findall(text) for number in match if number}
        missing += [f"{place}: ({number}), which none of {sorted(pages)} has" for number in sorted(cited - known)]
        beside = [(page, number) for page, *numbers in BESIDE_PAGE.findall(text) for number in numbers if number]
        beside += [(page, number) for number, page in BEFORE_PAGE.findall(text)]
        missing += [f"{place}: docs/{page}.md, ({number})" for page, number in beside if number not in _equations(page)]
        resolved += len(cited) + len(beside)
    assert not missing, "\n".join(missing)
    assert resolved > 60


def _riddles(tree: ast.Module) -> int:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.append(node.id)
        elif isinstance(node, ast.arg):
            names.append(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name.strip("_"))
    return sum(name.lower() in RIDDLES for name in names)


def test_riddling_names_only_become_fewer():
    counts: Counter[str] = Counter()
    for path, tree in _modules():
        folders = path.relative_to(PACKAGE).parts
        counts[folders[0] if len(folders) > 1 else "."] += _riddles(tree)
    more = {
        folder: (count, MOST_RIDDLES.get(folder, 0))
        for folder, count in counts.items()
        if count > MOST_RIDDLES.get(folder, 0)
    }
    assert not more, f"riddling names in these folders, and how many are allowed: {more}"
