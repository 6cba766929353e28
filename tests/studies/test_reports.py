"""What all studies share: the names on the command line, templates, tables, and that the package knows none of them."""

from __future__ import annotations

import re
import sys
import types
from importlib import import_module
from pathlib import Path

import jinja2
import numpy as np
import pytest
from matplotlib.figure import Figure

from studies import STUDIES, Request
from studies.__main__ import main
from studies.common import report

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "studies"
TEMPLATES = sorted(FOLDER.rglob("*.md.jinja"))


def test_every_name_that_a_report_prints_is_a_study():
    printed = set()
    for text in (ROOT / "docs").rglob("*.md"):
        if (ROOT / "docs" / "copied") in text.parents:  # made with the site; the changelog names studies that are gone
            continue
        for command in re.findall(r"python -m studies ([a-z-][a-z -]*)", text.read_text(encoding="utf-8")):
            printed |= {word for word in command.split(" --")[0].split() if not word.startswith("-")}
    assert {"covariance", "law", "joint-table"} <= printed <= {*STUDIES, "neural", "train", "info", "compare"}


@pytest.mark.parametrize("name", sorted(STUDIES))
def test_every_study_has_a_module_that_runs(name: str):
    pytest.importorskip("torch", reason="extra 'learn'")
    module = import_module(STUDIES[name][0])
    assert callable(module.run)
    assert f'"{name}"' in (module.__doc__ or "").splitlines()[0]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: str(path.relative_to(FOLDER)))
def test_templates_parse_and_are_filled_by_a_module_beside_them(path: Path):
    environment = jinja2.Environment(autoescape=True)
    environment.filters |= dict.fromkeys(("f", "n", "each", "mean", "median", "quantile"), str)
    environment.parse(path.read_text(encoding="utf-8"))
    stem = path.name.removesuffix(".md.jinja")
    module = path.with_name(f"{'run' if stem == 'report' else stem}.py").relative_to(ROOT).with_suffix("")
    assert ".".join(module.parts) in {module for module, _ in STUDIES.values()}


def test_a_template_is_filled_strictly(tmp_path: Path):
    template = tmp_path / "x.md.jinja"
    template.write_text(
        "# A\n\n{{ for_looking }}\n\n{% for v in values %}\n- {{ v|f('.2f') }}\n{% endfor %}\n\n{{ rest }}\n"
    )
    request = Request(out=tmp_path, quick=True)
    with pytest.raises(jinja2.UndefinedError, match="rest"):
        report.render(request, template, {"values": [1.0]})
    facts = {"values": [1.0, 2.345], "rest": "end"}
    text = report.render(request, template, facts)
    assert text == "# A\n\n_Quick run: a preview, not for citation._\n\n- 1.00\n- 2.35\n\nend\n"
    assert "Quick" not in report.render(Request(out=tmp_path), template, facts)


@pytest.mark.parametrize(("stem", "template"), [("short", "short"), ("run", "report")])
def test_a_report_has_the_template_and_the_constants_of_its_module(tmp_path: Path, stem: str, template: str):
    facts = {"word": "at", "rows": [{"a": 1, "b": 0.1234567}], "tables": {"wrong": [{"c": "?"}]}}
    module = types.ModuleType("made_up")
    module.__file__, module.LIMIT, module.FULL, module.QUICK = str(tmp_path / f"{stem}.py"), 3, 8, 2  # type: ignore[attr-defined]
    module.run = lambda settings, request: facts | {"figures": {"": Figure(), "map": Figure()}}  # type: ignore[attr-defined]
    words = "{{ word }} {{ study.LIMIT }} {{ s }}{{ flag }} {{ figures[1].name }}"
    (tmp_path / f"{template}.md.jinja").write_text(words)
    request = Request(out=tmp_path, quick=True)
    written = report.make(request, "x-y", module)
    assert [path.name for path in written] == ["x_y.md", "x_y.png", "x_y_map.png", "x_y.csv", "x_y_wrong.csv"]
    assert written[0].read_text() == "at 3 2 --quick x_y_map.png\n"
    assert written[3].read_text() == "a,b\n1,0.123457\n"
    facts["tables"] = {"wrong": []}
    assert len(report.make(request, "x-y", module)) == 4
    assert not (tmp_path / "x_y_wrong.csv").exists(), "what an earlier run wrote would be taken for this one's"
    assert report.make(request, "x-y", module, 5)[0].read_text().startswith("at 3 5")


def test_filters_and_tables():
    assert [report.number(v) for v in (1.23456, 12345.6, 3e7, 7, "x")] == ["1.235", "12346", "3e+07", "7", "x"]
    assert report.table([]) == ""
    assert report.table([{"a": 1, "b": 0.5}, {"a": 123456.0, "b": "x"}]) == (
        "| a | b |\n|---|---|\n| 1 | 0.5 |\n| 123456 | x |"
    )
    values = np.array([1.0, 2.0, 4.0])
    examples = jinja2.Environment(autoescape=False)
    examples.filters |= report.FILTERS
    made = examples.from_string("{{ v|each }} {{ v|mean|f('.3f') }} {{ v|median|n }} {{ v|quantile(1.0)|n }}").render(
        v=values
    )
    assert made == "1, 2, 4 2.333 2 4"


def test_without_jinja_it_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert main(["law", "--quick", "--out", str(tmp_path)]) == 2
    assert "pip install 'mars-lidar[studies]'" in capsys.readouterr().err
