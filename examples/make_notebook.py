"""Run the cells of tutorial.py and write tutorial.ipynb, with what they show: python examples/make_notebook.py."""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def cells(text: str) -> list[tuple[str, str]]:
    """Kind and source of each cell, between lines that begin with ``# %%``."""
    cells_of_text = []
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if "markdown" in head:
            lines = body.strip().splitlines()
            cells_of_text.append(("markdown", "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines)))
        else:
            cells_of_text.append(("code", body.strip()))
    return cells_of_text


def run(source: str, space: dict[str, Any]) -> list[dict[str, Any]]:
    """Run a cell; what it printed, and what its last line is, as a notebook keeps them."""
    tree, outputs = ast.parse(source), []
    last = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), space)
        value = None if last is None else eval(compile(last, "cell", "eval"), space)
    if printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue()})
    if value is not None:
        data = {"text/plain": repr(value)}
        if hasattr(value, "savefig"):
            file = io.BytesIO()
            value.savefig(file, format="png", dpi=72)
            data["image/png"] = base64.b64encode(file.getvalue()).decode()
        elif hasattr(value, "_repr_html_"):
            data["text/html"] = value._repr_html_()
        outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
    return outputs


def notebook() -> dict[str, Any]:
    """The notebook, executed."""
    space: dict[str, Any] = {}
    made: list[dict[str, Any]] = []
    for number, (kind, source) in enumerate(cells((HERE / "tutorial.py").read_text()), start=1):
        cell = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source}
        made.append(cell | ({"execution_count": number, "outputs": run(source, space)} if kind == "code" else {}))
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": kernel, "cells": made}


if __name__ == "__main__":
    (HERE / "tutorial.ipynb").write_text(json.dumps(notebook(), indent=1, ensure_ascii=False) + "\n")
