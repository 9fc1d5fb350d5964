"""The files of a document of results."""

import json

import pandas as pd

from neuroprior.report.document import Document, write_document


def test_files_hold_renamed_columns_under_both_names(tmp_path):
    frame = pd.DataFrame({"context": ["none", "initial"], "bits": [1.5, None]})
    document = Document("", "", [], {"rows": frame}, former_names={"context": "sees"})
    write_document(document, tmp_path)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert rows == [
        {"context": "none", "bits": 1.5, "sees": "none"},
        {"context": "initial", "bits": None, "sees": "initial"},
    ]
    assert pd.read_csv(tmp_path / "rows.csv")["sees"].tolist() == ["none", "initial"]
    assert list(frame) == ["context", "bits"]
