# make paper: the paper's simulations. make test: everything that is checked before a change lands.
PYTHON ?= python3
BIN := .venv/bin
export PYTHONPATH :=

.PHONY: paper test check bench clean

paper: .venv/programs
	$(BIN)/python -m eval paper

test: check
	$(BIN)/python -m pytest

check: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy neuroprior

bench: .venv/programs
	$(BIN)/python -m eval bench

clean:
	rm -rf .venv

.venv/%: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	touch $@
