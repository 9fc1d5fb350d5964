"""Extra docs: a page is built with the site's extensions and theme, and its code is executed."""

import subprocess
import sys
from pathlib import Path

Path("conf.py").write_text(
    'extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb", "sphinx_design"]\n'
    'html_theme = "pydata_sphinx_theme"\nnb_execution_mode = "force"\nnb_execution_raise_on_error = True\n'
)
Path("index.md").write_text("""---
jupytext:
  text_representation:
    format_name: myst
kernelspec:
  name: python3
---

# Page

```{code-cell} python3
import neuroprior
print(neuroprior.__version__)
```
""")
subprocess.run([sys.executable, "-m", "sphinx", "-b", "html", "-q", "-W", ".", "html"], check=True)
assert "output" in Path("html/index.html").read_text(encoding="utf-8")
