"""Extra cli: the commands of the README's "Your own data", with little training."""

import subprocess
import sys
from pathlib import Path

PROGRAM = str(Path(sys.executable).with_name("neuroprior"))
STUDY = ["study.csv"]
for words in (
    ["example", "study.csv"],
    ["check", *STUDY],
    [
        "fit",
        "--config",
        "gru",
        *STUDY,
        "--out",
        "mine",
        "--max-steps",
        "20",
        "--folds",
        "1",
    ],
    ["score", "mine", *STUDY],
    ["sample", "mine", "--num-plans", "5", "--length", "4"],
    ["report", *STUDY, "--models", "counts", "--out", "report"],
):
    subprocess.run([PROGRAM, *words], check=True, stdout=subprocess.DEVNULL)
