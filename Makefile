# make paper: the paper's simulations. make mice: mice in a labyrinth, make mice-planner: whether they help a planner. make test: everything that is checked before a change lands. make docs: the site. make results: all that the pages of results show, most of a day; it goes on where it was interrupted.
PYTHON ?= python3
BIN := .venv/bin
# One thread a process: two processes of two threads each wait for one another.
PYTEST := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder
export PYTHONPATH :=

.PHONY: paper mice mice-planner results test check style types pytest slow mutants bench docs clean

paper: .venv/cli
	$(BIN)/python -m eval paper

mice: .venv/cli
	$(BIN)/python -m eval plans eval/data/labyrinth/plans.jsonl --skip 1 --models counts combined --out runs/mice

mice-planner: .venv/cli
	$(BIN)/python -m eval mice --out runs/mice-planner

results: .venv/all
	$(BIN)/python -m eval pages

# Types take a minute on one core, so they are checked beside the tests.
test: style
	$(MAKE) --no-print-directory -j 2 types pytest || { echo "types or tests failed, see above"; exit 1; }

check: style types

style: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/dev
	$(BIN)/mypy neuroprior train eval tests/typing

pytest: .venv/dev
	$(PYTEST)

# What takes too long for each change: to be run before a release, and after changes to what is learned.
slow: .venv/dev
	$(PYTEST) -m slow

# Faults planted in the library, and which of them the tests catch: another sample each time, an hour or two.
mutants: .venv/dev
	$(BIN)/python -m tests.support.mutants

bench: .venv/bench
	$(BIN)/python -m eval bench

# -n -W: a name that leads nowhere, and any other warning, is an error. The notebooks are run.
docs: .venv/docs
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m sphinx -b html -q -n -W --keep-going docs docs/_build/html
	@echo docs/_build/html/index.html

clean:
	rm -rf .venv

.venv/%: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	touch $@
