"""Extra dev: tests that lie in the sdist pass, in what it unpacks to."""

import subprocess
import sys
import tarfile
from pathlib import Path

(archive,) = Path(sys.argv[1]).parent.glob("*.tar.gz")
with tarfile.open(archive) as file:
    file.extractall(".", filter="data")
folder = archive.name.removesuffix(".tar.gz")
subprocess.run([sys.executable, "-m", "pytest", "-q", "tests/plans", "tests/priors/counts"], cwd=folder, check=True)
