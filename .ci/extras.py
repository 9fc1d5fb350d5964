"""Wheel and sdist, built, checked, and tried in fresh environments: each extra alone, and each constraints file.

    python .ci/extras.py                       # everything; needs 6 GB of disk at a time
    python .ci/extras.py --only core lowest

Needs Python and a package index; nothing else. An environment is removed when it was tried. The table of results is
printed as it grows; exit status 1 if anything failed.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SMOKE = ROOT / ".ci" / "smoke"
EXTRAS = ("report", "tables", "cli", "dask", "gym", "mujoco", "bench", "docs", "dev")
LIBRARY = ("report", "tables", "cli", "dask", "gym", "mujoco")
"""The extras without those whose packages only compare, build pages or test."""

ENVIRONMENTS: dict[str, tuple[tuple[str, ...], str]] = {
    "core": ((), "constraints.txt"),
    **{extra: ((extra,), "constraints.txt") for extra in EXTRAS},
    "highest": (("all",), "constraints.txt"),
    "lowest": (LIBRARY, "constraints-lowest.txt"),
}
"""The extras of each environment, and the file with its versions."""

SHOWN = ("torch", "numpy", "lightning")
VERSIONS = f"from importlib.metadata import version; print(*[version(name) for name in {SHOWN}])"


def programs(name: str) -> list[Path]:
    """What is run in an environment: the core's program in that without extras and in those of many, one an extra."""
    extras = ENVIRONMENTS[name][0]
    core = [SMOKE / "core.py"] if len(extras) != 1 or extras == ("all",) else []
    return core + [SMOKE / f"extra_{extra}.py" for extra in (EXTRAS if extras == ("all",) else extras)]


def environment(folder: Path) -> Path:
    """A fresh one; its Python."""
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


def install(python: Path, *what: str) -> None:
    run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *what], ROOT)


def run(command: list[str], folder: Path) -> str:
    """What a program printed. It knows nothing of this checkout but what it is given."""
    return subprocess.run(
        ["env", "-u", "PYTHONPATH", *command],
        cwd=folder,
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ).stdout


def build(folder: Path) -> Path:
    """The wheel, beside the sdist from which it was made; both pass `twine check`."""
    python = environment(folder / "tools")
    install(python, "build", "twine")
    run([str(python), "-m", "build", "--outdir", str(folder / "dist"), str(ROOT)], folder)
    made = sorted(map(str, (folder / "dist").iterdir()))
    print(run([str(python), "-m", "twine", "check", "--strict", *made], folder).strip(), flush=True)
    return next((folder / "dist").glob("*.whl"))


def tried(name: str, wheel: Path, folder: Path) -> str:
    """A row of the table: versions, size, and what came of each program."""
    extras, constraints = ENVIRONMENTS[name]
    shown = f"| {name} | "
    begin = time.perf_counter()
    python = environment(folder / "env")
    try:
        install(python, "-c", str(ROOT / constraints), f"{wheel}[{','.join(extras)}]" if extras else str(wheel))
        run([str(python), "-m", "pip", "check"], folder)
    except subprocess.CalledProcessError as error:
        return shown + f"| | | | FAILED to install: {last_line(error)} |"
    shown += " | ".join(run([str(python), "-c", VERSIONS], folder).split())
    size = sum(path.lstat().st_size for path in (folder / "env").rglob("*") if path.is_file()) / 2**20
    shown += f" | {size:,.0f} MiB, {time.perf_counter() - begin:.0f} s | "
    said = []
    for program in programs(name):
        place = folder / "work" / program.stem
        place.mkdir(parents=True)
        about = str(wheel) if program.stem == "extra_dev" else str(ROOT / "README.md")
        begin = time.perf_counter()
        try:
            run([str(python), str(program), about], place)
            said.append(f"{program.stem.removeprefix('extra_')} passed ({time.perf_counter() - begin:.0f} s)")
        except subprocess.CalledProcessError as error:
            said.append(f"{program.stem.removeprefix('extra_')} FAILED: {last_line(error)}")
    return shown + ", ".join(said) + " |"


def last_line(error: subprocess.CalledProcessError) -> str:
    print(error.stdout, file=sys.stderr)
    return (error.stdout.strip() or "no output").splitlines()[-1].replace("|", "/")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(ENVIRONMENTS), default=list(ENVIRONMENTS), metavar="NAME")
    names = parser.parse_args().only
    with tempfile.TemporaryDirectory() as place:
        wheel = build(Path(place))
        print(f"| environment | {' | '.join(SHOWN)} | size | programs |\n|---|---|---|---|---|---|", flush=True)
        rows = []
        for name in names:
            folder = Path(place) / name
            rows.append(tried(name, wheel, folder))
            print(rows[-1], flush=True)
            shutil.rmtree(folder)
    return int(any("FAILED" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
