"""The files of a document of results."""

import json
from dataclasses import replace
from io import StringIO

import pandas as pd
import pytest
from rich.console import Console

from neuroprior.behaviour.reporting.document import Document, show, write_document
from neuroprior.behaviour.reporting.page import Section, Table
from neuroprior.behaviour.reporting.part import p_text
from tests.support.sources import refuses


def test_a_table_that_is_empty_now_leaves_no_file_of_an_earlier_run(tmp_path):
    full = pd.DataFrame({"bits": [1.5]})
    write_document(Document("", "", [], {"one": full, "two": full}), tmp_path)
    write_document(Document("", "", [], {"one": full, "two": full[:0]}), tmp_path)
    assert {path.name for path in tmp_path.glob("*.csv")} == {"one.csv"}
    assert json.loads((tmp_path / "results.json").read_text())["two"] == []


def test_a_table_that_another_document_has_not_leaves_no_file_but_other_files_stay(tmp_path):
    full = pd.DataFrame({"bits": [1.5]})
    for name in ("mine", "settings"):
        (tmp_path / f"{name}.csv").write_text("a\n1\n")
    for keys in ({}, {"two": "second"}):
        write_document(Document("", "", [], {"one": full, "two": full}, keys=keys), tmp_path)
        write_document(Document("", "", [], {"one": full}, keys=keys), tmp_path)
        assert {path.name for path in tmp_path.glob("*.csv")} == {"one.csv", "mine.csv", "settings.csv"}


def test_tables_are_printed_under_their_own_titles_else_that_of_their_section():
    shown = [Table(["a wide heading"], [["1"]], title="Own title")]
    shown += [Table(["a wide heading"], [["2"]], caption="A caption")]
    stream = StringIO()
    show(Document("", "The lead.", [Section("Its section", tables=shown)]), Console(file=stream, width=80))
    said = [line.strip() for line in stream.getvalue().splitlines() if line.strip()]
    assert [line for line in said if line in ("Own title", "Its section", "A caption", "The lead.")] == [
        "Own title",
        "Its section",
        "A caption",
        "The lead.",
    ]


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "<1e-300"), (1e-12, "1e-12"), (0.0043, "0.004"), (0.26, "0.3"), (1.0, "1")]
)
def test_p_values_have_a_digit(value, text):
    assert p_text(value) == text


@pytest.mark.parametrize("content", ['{"subjects": [1, 2]}', "[1, 2]", "{"])
def test_results_of_another_program_are_not_written_over(content, tmp_path):
    (tmp_path / "results.json").write_text(content)
    (tmp_path / "subjects.csv").write_text("a\n1\n")
    with refuses("`out` must be a folder without results.json"):
        write_document(Document("", "", [], {"one": pd.DataFrame({"bits": [1.5]})}), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"results.json", "subjects.csv"}
    assert (tmp_path / "results.json").read_text() == content


@pytest.mark.parametrize("name", ["one.csv", "report.html"])
def test_files_of_others_are_not_written_over(name, tmp_path):
    document = Document("", "", [], {"one": pd.DataFrame({"bits": [1.5]}), "empty": pd.DataFrame()})
    (tmp_path / name).write_text("a\n1\n")
    with refuses(f"`out` must be a folder without {name}, or with that of an earlier run, got {tmp_path}"):
        write_document(document, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    (tmp_path / name).unlink()
    write_document(document, tmp_path)
    # Beside an earlier report, too; what the earlier one wrote is its own.
    more = replace(document, frames={"one": document.frames["one"], "two": document.frames["one"]})
    (tmp_path / "two.csv").write_text("a\n1\n")
    with refuses("`out` must be a folder without two.csv"):
        write_document(more, tmp_path)
    (tmp_path / "two.csv").unlink()
    write_document(more, tmp_path)
    write_document(document, tmp_path)
    assert {path.name for path in tmp_path.glob("*.csv")} == {"one.csv"}
