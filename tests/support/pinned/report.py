"""The report on a file of plans, and the engine of all reports: text, tables, the data behind figures, files."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
from rich.console import Console

from neuroprior.priors import MarkovPrior, UniformPrior
from neuroprior.report import (
    Document,
    FigureBox,
    Section,
    ethogram_figure,
    publish,
    report,
    table,
    transition_figure,
)
from neuroprior.report.document import printed, results_of, write_figures
from tests.support.pinned.data import behaviour, timed
from tests.support.reports import QUICK
from tests.support.studies import between, study, within
from tests.support.unchanged import case


def of_document(document: Document, figures: bool = True) -> dict[str, Any]:
    """Everything that a reader sees."""
    results = results_of(document)
    found: dict[str, Any] = {"title": document.title, "lead": document.lead, "settings": results["settings"]}
    for number, section in enumerate(document.sections):
        found[f"{number} {section.title}"] = {
            "text": section.text,
            "beside": section.beside,
            "tables": [vars(one) for one in section.tables],
            "figures": [{"name": box.name, "caption": box.caption, "alt": box.alt} for box in section.figures],
        }
    found["frames"] = dict(document.frames)
    found["results"] = {
        key: value
        for key, value in results.items()
        if key not in ("versions", "settings", *document.frames, *document.keys.values())
    }
    return found | ({"figures": document.figures} if figures else {})


@case(relative=2e-3)
def report_on_plans():
    """All sections, with groups, conditions and durations."""
    plans = study(5, between(6), 20, 4, slower={1: 1.5})
    names = ["eat", "groom", "rest", "walk"]
    plans = type(plans)(**{**vars(plans), "action_names": names})
    return of_document(report(plans, **QUICK, folds=2, command="neuroprior report plans.csv"))


@case(relative=2e-3, slow=True)
def report_on_modes():
    made = report(behaviour(12, 10, context="step"), **QUICK, folds=2, modes=[2], sections=["modes"])
    return of_document(made) | {"frames": made.frames}


@case(relative=2e-3)
def report_on_paired_conditions():
    """Each animal under both."""
    plans = study(7, within(6, 2), 20, 3, slower={1: 2.0})
    return of_document(report(plans, **QUICK, folds=2, sections=["conditions", "durations"]))


@case(relative=2e-3, slow=True)
def report_with_contexts():
    """A context of each step, a network beside the counts, the first actions left out; scored on other plans."""
    plans, test = behaviour(30, context="step"), behaviour(14, context="step", seed=5)
    how: dict[str, Any] = {
        "models": ["counts", "gru", "stacked", "combined"],
        "max_steps": 2,
        "processes": 1,
        "skip": 1,
    }
    sections = [
        "file",
        "scores",
        "lags",
        "orders",
        "calibration",
        "transitions",
        "motifs",
        "macros",
        "likeness",
        "drift",
    ]
    return of_document(report(plans, test=test, **how, sections=sections))


@case
def report_on_one_plan():
    """It is cut into parts."""
    return of_document(report(timed(1, 160), **QUICK), figures=False)


@case
def report_on_saved_priors():
    plans = timed(12, 9)
    priors = {"chain": MarkovPrior(3, 1).fit(plans), "nothing": UniformPrior(3)}
    return of_document(report(plans, priors=priors, sections=["scores", "calibration", "likeness", "drift"]))


@case
def pages():
    """A document printed and written: the terminal, the page without its drawings, tables and JSON."""
    frame = pd.DataFrame({"name": ["a", "b & c"], "bits": [1.25, None], "number": [3, 4]})
    shown = table(
        frame, {"name": "name", "bits": "bits:.2f", "more": lambda row: f"{row['number']:,}"}, "What it is.", "One"
    )
    box = FigureBox(
        transition_figure([[0.2, 0.8], [1.0, 0.0]], ["a", "b"], "Title"), "Its caption.", "Its text.", "matrix"
    )
    sections = [
        Section("First", ["Some *text*.", "More."], [shown], [box]),
        Section("Second", tables=[shown], beside=True),
    ]
    document = Document(
        "Title <1>", "A lead.", sections, {"rows": frame}, {"seed": 1}, "python -m it", {"more": [1]}, {"rows": "all"}
    )
    with TemporaryDirectory() as folder:
        with open(Path(folder) / "out.txt", "w") as out:
            publish(document, Path(folder) / "page", Console(file=out, width=80))
        write_figures(Path(folder) / "page", {"alone": box.figure})
        with open(Path(folder) / "narrow.txt", "w") as out:
            names = pd.DataFrame({"name": ["a name that is far too long for it"], "bits": [12345.678]})
            narrow = table(names, {"a heading": "name", "bits": "bits:.3f"}, "A caption.", "Two")
            Console(file=out, width=24).print(printed("Two", narrow))
        files = sorted(path.name for path in (Path(folder) / "page").iterdir())
        page = (Path(folder) / "page" / "report.html").read_text()
        body = page[page.index("<body") :]
        parts = [part.split("</svg>")[-1] for part in body.split("<svg")]
        results = json.loads((Path(folder) / "page" / "results.json").read_text())
        return {
            "printed": (Path(folder) / "out.txt").read_text().replace(folder, "").splitlines()[:-1],
            "files": files,
            "narrow": (Path(folder) / "narrow.txt").read_text().splitlines(),
            "page": [line for part in parts for line in part.splitlines() if line.strip() and "version" not in line],
            "results": {key: value for key, value in results.items() if key != "versions"},
            "table": (Path(folder) / "page" / "rows.csv").read_text(),
        }


@case
def ethograms():
    return [ethogram_figure(timed(9, 8)), ethogram_figure(behaviour(70, 30, 14))]
