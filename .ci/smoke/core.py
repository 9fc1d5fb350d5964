"""The library without extras: the planner of the README; what needs an extra says which."""

import re
import sys
from pathlib import Path

from neuroprior import from_gymnasium, read_plans

readme = Path(sys.argv[1]).read_text(encoding="utf-8")
(example,) = re.findall(r"## A planner with a prior\n\n```python\n(.*?)```", readme, re.DOTALL)
exec(compile(example, "README.md", "exec"), {"__name__": "example"})

Path("events.csv").write_text("plan,action\na,walk\na,rest\n")
for needs, extra in ((lambda: read_plans("events.csv"), "report"), (lambda: from_gymnasium("Taxi-v4"), "gym")):
    try:
        needs()
    except ImportError as error:
        if f"neuroprior[{extra}]" not in str(error):
            raise
