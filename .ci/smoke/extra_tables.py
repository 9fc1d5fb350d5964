"""Extra tables: a workbook and a Parquet file are read as recordings."""

import pandas as pd

from neuroprior.behaviour import read

frame = pd.DataFrame({"animal": ["m1", "m1"], "behaviour": ["rest", "walk"], "start": [0, 5], "stop": [5, 7]})
frame.to_parquet("study.parquet")
assert read("study.parquet").events["stop"].tolist() == [5, 7]
