"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.

A new study is a new folder: `registry.py` finds it by the first line of its module, `Study "name": ...`.
In a folder `run.py` computes what its report states and draws, `report.md.jinja` is the report. Some folders
hold several studies of one subject, a module and a template of its name for each. What they share is in `common`. All
run alike: `run(settings, request)` of the module, with its `FULL` or `QUICK` settings, returns the facts that the
template states, among them ``rows`` of the CSV file and ``figures`` by name; `common.report.make` writes them.
"""

from studies.request import Facts, OtherRunsError, Request, Tell

__all__ = ["Facts", "OtherRunsError", "Request", "Tell"]
