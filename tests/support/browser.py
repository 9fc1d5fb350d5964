"""Pages in a headless browser, at the widths of a phone and of a desktop; for tests."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

MEASURE = """<script>
const errors = [];
for (const kind of ["error", "securitypolicyviolation"])
  addEventListener(kind, e => errors.push(e.message || kind), true);
addEventListener("load", () => {
  const root = document.documentElement, text = document.querySelector("svg text");
  parent.postMessage({
    name: location.hash, errors, width: innerWidth, needs: Math.max(root.scrollWidth, document.body.scrollWidth),
    follows: getComputedStyle(text).fill == getComputedStyle(document.body).color,
    smallest: Math.min(...[...document.querySelectorAll("svg text")].map(t =>
      parseFloat(getComputedStyle(t).fontSize) * t.getScreenCTM().d).filter(height => height > 0)),
  }, "*");
});
</script>"""
GATHER = """<iframe src="page.html#phone" width="390" height="800"></iframe>
<iframe src="page.html#desktop" width="1280" height="800"></iframe>
<iframe src="wide.html#control" width="390" height="800"></iframe><pre></pre><script>
const measured = {};
addEventListener("message", e => {
  measured[e.data.name.slice(1)] = e.data; document.querySelector("pre").textContent = JSON.stringify(measured);
});
</script>"""


def check_in_browser(page: str, folder: Path) -> None:
    """A page is never wider than the window, and nothing is amiss; a page that is too wide is noticed."""
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("needs chromium on PATH")
    text = page.replace("<head>", "<head>" + MEASURE)
    (folder / "page.html").write_text(text)
    (folder / "wide.html").write_text(text.replace("<main>", '<main><div style="width: 600px">wide</div>'))
    (folder / "gather.html").write_text(GATHER)
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    command += ["--virtual-time-budget=10000", "--enable-logging=stderr", "--dump-dom"]
    run = subprocess.run([*command, (folder / "gather.html").as_uri()], capture_output=True, text=True, timeout=120)
    measured = json.loads(re.search("<pre>(.*)</pre>", run.stdout)[1])
    assert (measured["phone"]["width"], measured["desktop"]["width"]) == (390, 1280)
    assert measured["control"]["needs"] > 600
    assert ":CONSOLE" not in run.stderr
    for one in (measured["phone"], measured["desktop"]):
        assert one["needs"] <= one["width"]
        assert one["errors"] == []
        assert one["follows"]
        assert one["smallest"] >= 9.4
