# Two commands are all a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
# parallel test workers
WORKERS ?= 2

.PHONY: demo test test-dataset lint setup clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON): Python >= 3.11 is needed (set PYTHON=...)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@

# The main job, end to end, on synthetic human traffic: import, train, rank, export, draw.
demo: setup
	$(BIN)/python -m experiments.demo --output=$(OUT)

test: setup
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal -m "not slow and not dataset"

test-dataset: setup
	$(BIN)/python -m pytest -q -m "dataset"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) out build dist
