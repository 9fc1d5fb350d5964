"""Faults planted in the library, and whether the tests catch them: `make mutants`.

A fault is one change of the kind that programmers make: `any` for `all`, an index off by one, an option that is not
passed on. The tests that reach its line are run, the quickest first, until one fails. Which tests reach a line, a run
of the suite under coverage.py says; compiled code is not traced, so there those that reach its callers are run.
"""

import argparse
import ast
import csv
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from coverage import CoverageData

ROOT = Path(__file__).parents[2]

WINGS = ("behaviour", "control", "puzzles")

MAX_SECONDS, STARTING_SECONDS = 120.0, 60.0
"""Of tests that are run for a fault, as long as they take without it; and added before it is said to hang."""

NOT_RUN = (4, 5)
"""Exit codes of pytest where a test that it was given does not exist."""

SWAPPED_NAMES = {
    name: other
    for pair in ("any all", "min max", "argmin argmax", "amin amax", "sum mean", "floor ceil", "cumsum cumprod")
    for name, other in (pair.split(), pair.split()[::-1])
}
SWAPPED_OPERATORS: dict[type, type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip


class Fault(NamedTuple):
    """A change of the source: the characters from `start` to `end` of a file become `after`."""

    file: str
    line: int
    start: int
    end: int
    after: str

    def plant(self, source: str) -> str:
        """Return the source with the fault."""
        return source[: self.start] + self.after + source[self.end :]


class Reach(NamedTuple):
    """Which tests reach a line, and how long each takes."""

    tests: dict[str, dict[int, list[str]]]
    seconds: dict[str, float]
    sources: dict[str, str]
    compiled: dict[str, list[tuple[int, int, str]]]

    def of(self, fault: Fault) -> list[str]:
        """The tests that reach a fault, up to `MAX_SECONDS`: those of its own room first, and quick ones."""
        chosen, left, rooms = [], MAX_SECONDS, set(re.split(r"[/_.]", fault.file))

        def rank(test: str) -> tuple[int, float]:
            return -len(rooms & set(re.split(r"[/_.]", test.partition("::")[0]))), self.seconds[test]

        for test in sorted(self._reaching(fault.file, fault.line), key=rank):
            left -= self.seconds[test]
            if chosen and left < 0:
                break
            chosen.append(test)
        return chosen

    def _reaching(self, file: str, line: int) -> set[str]:
        """The tests that reach a line; of compiled code those that reach a call of it, or a call of its caller."""
        reached, names, callers = set(self.tests[file].get(line, [])), set[str](), [(file, line)]
        while callers and not reached:
            named = {self._compiled_at(*place) for place in callers} - names - {None}
            names |= named
            callers = [
                (other, source.count("\n", 0, call.start()) + 1)
                for name in named
                for other, source in self.sources.items()
                for call in re.finditer(rf"(?<!def )\b{name}\(", source)
            ]
            reached = {test for other, number in callers for test in self.tests[other].get(number, [])}
        return reached

    def _compiled_at(self, file: str, line: int) -> str | None:
        """The name of the compiled function that a line is in."""
        return next((name for first, last, name in self.compiled[file] if first <= line <= last), None)


def find_faults(file: str, source: str) -> list[Fault]:
    """Return all faults that can be planted in the functions of a file; none in messages, types and decorators."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for text in lines:
        starts.append(starts[-1] + len(text))

    def place(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    faults = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                for node in _reachable(statement):
                    for changed in _changes(node):
                        start = place(node.lineno, node.col_offset)
                        end = place(node.end_lineno or 0, node.end_col_offset or 0)
                        after = changed if isinstance(changed, str) else ast.unparse(changed)
                        if isinstance(changed, ast.expr):
                            after = f"({after})"
                        faults.append(Fault(file, node.lineno, start, end, after))
    return sorted(set(faults))


def _reachable(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """The nodes below one, without messages, types and functions inside (which are visited on their own)."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.ClassDef | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.expr | ast.stmt):
        yield node
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "decorator_list", "returns"):
            continue
        for one in child if isinstance(child, list) else [child]:
            if isinstance(one, ast.AST):
                yield from _reachable(one)


def _changes(node: ast.expr | ast.stmt) -> Iterator[ast.expr | str]:
    """What may stand in the place of a node."""
    match node:
        case ast.Compare(left, [operator], [right]):
            if (other := SWAPPED_OPERATORS.get(type(operator))) is not None:
                yield ast.Compare(left, [other()], [right])  # type: ignore[list-item]
        case ast.BinOp(left, operator, right):
            texts = [one for one in (left, right) if isinstance(one, ast.JoinedStr) or _is_text(one)]
            if (other := SWAPPED_OPERATORS.get(type(operator))) is not None and not texts:
                yield ast.BinOp(left, other(), right)  # type: ignore[arg-type]
        case ast.BoolOp(operator, values):
            yield ast.BoolOp(SWAPPED_OPERATORS[type(operator)](), values)  # type: ignore[arg-type]
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield operand
        case ast.Constant(bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(int() as value):
            yield ast.Constant(value + 1)
        case ast.IfExp(test, body, orelse):
            yield ast.IfExp(test, orelse, body)
        case ast.Call(function, arguments, keywords):
            yield from _changed_calls(function, arguments, keywords)
        case ast.Expr(ast.Call()) | ast.AugAssign():
            yield "pass"
        case ast.Break():
            yield "continue"
        case ast.Continue():
            yield "break"


def _changed_calls(function: ast.expr, arguments: list[ast.expr], keywords: list[ast.keyword]) -> Iterator[ast.expr]:
    """Another function, an option less, two arguments in the wrong order."""
    match function:
        case ast.Name(name) if name in SWAPPED_NAMES:
            yield ast.Call(ast.Name(SWAPPED_NAMES[name]), arguments, keywords)
        case ast.Attribute(owner, name) if name in SWAPPED_NAMES:
            yield ast.Call(ast.Attribute(owner, SWAPPED_NAMES[name]), arguments, keywords)
    for left_out in keywords:
        if left_out.arg not in (None, "device"):  # which is the CPU in tests
            yield ast.Call(function, arguments, [keyword for keyword in keywords if keyword is not left_out])
    match arguments:
        case [ast.Name(one) as first, ast.Name(other) as second] if one != other:
            yield ast.Call(function, [second, first], keywords)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def read_reach(folder: Path) -> Reach:
    """Read what `measure` wrote to a folder."""
    data = CoverageData(str(folder / "coverage"))
    data.read()
    seconds = defaultdict[str, float](float)
    for duration, test in re.findall(r"^([\d.]+)s \w+ +(\S.*)$", (folder / "log").read_text("utf-8"), re.MULTILINE):
        seconds[test] += float(duration)
    tests, sources, compiled = {}, {}, {}
    for path in sorted((ROOT / "neuroprior").rglob("*.py")):
        file = str(path.relative_to(ROOT))
        sources[file] = path.read_text(encoding="utf-8")
        found = [node for node in ast.walk(ast.parse(sources[file])) if isinstance(node, ast.FunctionDef)]
        compiled[file] = [
            (node.lineno, node.end_lineno or 0, node.name)
            for node in found
            if any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
        ]
        reached = data.contexts_by_lineno(str(path))
        tests[file] = {line: [name.rpartition("|")[0] for name in names if name] for line, names in reached.items()}
    return Reach(tests, seconds, sources, compiled)


def measure(folder: Path) -> None:
    """Run the quick lane under coverage.py, and write to a folder which tests reach which lines."""
    folder.mkdir(parents=True, exist_ok=True)
    settings = folder / "settings"
    settings.write_text(f"[run]\nsource = neuroprior\ndata_file = {folder / 'coverage'}\n", encoding="utf-8")
    options = [f"--cov-config={settings}", "--cov-context=test", "--cov-report=", "--durations=0", "-vv"]
    command = [sys.executable, "-m", "pytest", "-n", "auto", "--dist", "loadfile", "--cov=neuroprior", *options]
    with open(folder / "log", "w", encoding="utf-8") as log:
        subprocess.run(command, cwd=ROOT, stdout=log, check=True)


def try_fault(fault: Fault, reach: Reach, copies: "SimpleQueue[Path]") -> str:
    """Plant a fault in a copy of the checkout and run the tests that reach it; return what became of it."""
    tests = reach.of(fault)
    if not tests:
        return "no test reaches it"
    copy = copies.get()
    path, source = copy / fault.file, reach.sources[fault.file]
    try:
        path.write_text(fault.plant(source), encoding="utf-8")
        failed = _first_failure(copy, tests, STARTING_SECONDS + 5 * sum(reach.seconds[test] for test in tests))
        path.write_text(source, encoding="utf-8")
        if failed in tests and _first_failure(copy, [failed], 5 * STARTING_SECONDS):
            return f"{failed} fails without it"
    finally:
        path.write_text(source, encoding="utf-8")
        copies.put(copy)
    return f"caught by {failed}" if failed else "survived"


def _first_failure(copy: Path, tests: list[str], limit: float) -> str:
    """The first of the tests that fails in a copy, or why none ends well; "" if all pass."""
    (copy / "chosen").write_text("\n".join(tests), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-rfE", "-p", "no:cacheprovider", "@chosen"]
    environment = os.environ | {"PYTHONPATH": str(copy)}
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired:
        return "no end"
    if done.returncode in NOT_RUN and "ERROR collecting" not in done.stdout:
        said = done.stdout[-1000:] + done.stderr[-1000:]
        raise RuntimeError(f"tests are others than when the coverage was measured; delete it\n{said}")
    if done.returncode == 0:
        return ""
    named = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return named[1] if named else "no start"


def room_of(file: str) -> str:
    """The wing that a file is in, or the core."""
    room = Path(file).parts[1]
    return room if room in WINGS else "core"


def sample_faults(sources: dict[str, str], number: int, seed: int, rooms: list[str]) -> list[Fault]:
    """Draw as many faults from each room."""
    drawn, faults = random.Random(seed), defaultdict[str, list[Fault]](list)
    for file, source in sources.items():
        faults[room_of(file)] += find_faults(file, source)
    return [fault for room in rooms for fault in drawn.sample(faults[room], number // len(rooms))]


def main() -> None:
    """Plant a sample of faults and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=200, help="how many faults, in equal shares for each room")
    parser.add_argument("--seed", type=int, default=random.randrange(10**6), help="of the sample; drawn by default")
    parser.add_argument("--rooms", nargs="+", default=["core", *WINGS], choices=["core", *WINGS])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/mutants"), help="folder for coverage and results")
    given = parser.parse_args()
    if not (given.out / "log").exists():
        print("which tests reach which lines: a run of the suite, some 10 minutes", flush=True)
        measure(given.out.absolute())
    reach = read_reach(given.out)
    faults = sample_faults(reach.sources, given.number, given.seed, given.rooms)
    print(f"{len(faults)} faults, seed {given.seed}", flush=True)
    copies: SimpleQueue[Path] = SimpleQueue()
    outcomes, rows = defaultdict[str, Counter[str]](Counter), []
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(given.processes) as pool:
        for number in range(given.processes):
            left_out = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", "_build", ".*_cache")
            copies.put(Path(shutil.copytree(ROOT, Path(temporary) / str(number), ignore=left_out)))
        outcome_of = partial(try_fault, reach=reach, copies=copies)
        for fault, outcome in zip(faults, pool.map(outcome_of, faults), strict=True):
            before = reach.sources[fault.file][fault.start : fault.end]
            rows.append([fault.file, fault.line, " ".join(before.split()), fault.after, outcome])
            outcomes[room_of(fault.file)][outcome.partition(" ")[0]] += 1
            if not outcome.startswith("caught"):
                print(f"{outcome}: {fault.file}:{fault.line}: {rows[-1][2]} -> {fault.after}", flush=True)
    with open(given.out / f"mutants_{given.seed}.csv", "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([["file", "line", "before", "after", "outcome"], *rows])
    for room, counts in outcomes.items():
        print(f"{room}: {counts['caught']} of {counts.total()} caught")


if __name__ == "__main__":
    main()
