# Two commands are all a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
# parallel test workers
WORKERS ?= 2
# folder of recordings for `make bench`; what is not there is left out
RECORDINGS ?= ../shared/data

.PHONY: demo test test-slow test-dataset lint bench docs onboard setup clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON): Python >= 3.11 is needed (set PYTHON=...)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@

# The main job, end to end, on synthetic human traffic: import, train, rank, simulate, gate, report.
demo: setup
	$(BIN)/python -m experiments.autotune --workdir=$(OUT) --stride=6 --epochs=6 --cases=10 --duration=20

test: setup
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal -m "not slow and not dataset"

test-dataset: setup
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal -m "dataset"

# Killed processes, lost Ray nodes, memory, the tutorial as written; one at a time
test-slow: setup
	$(BIN)/python -m pytest -q -m "slow and not dataset"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

$(VENV)/.bench: pyproject.toml | setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	@touch $@

# All benchmarks, three quarters of an hour; wants a quiet machine. Writes benchmarks/results and
# the pictures of docs/performance.md.
bench: export JAX_PLATFORMS = cpu
bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.layouts
	$(BIN)/python -m benchmarks.scaling
	$(BIN)/python -m benchmarks.sweep
	$(BIN)/python -m benchmarks.suite
	taskset -c 0 $(BIN)/python -m benchmarks.dp
	taskset -c 0 $(BIN)/python -m benchmarks.single_plan
	taskset -c 0 $(BIN)/python -m benchmarks.onboard
	$(BIN)/python -m benchmarks.importing --data=$(RECORDINGS)
	$(BIN)/python -m benchmarks.streaming
	$(BIN)/python -m benchmarks.memory
	$(BIN)/python -m benchmarks.paper_scale
	$(BIN)/python -m benchmarks.plots

# Documentation as a site; warnings are errors
docs: export NO_MKDOCS_2_WARNING = 1
docs: setup
	$(BIN)/python -m mkdocs build --strict --quiet
	@echo "site: build/site/index.html"

# C++ reader; needs cmake, a C++17 compiler and libmsgpack-dev
onboard:
	cmake -S onboard -B build/onboard -DRCIRL_WERROR=ON
	cmake --build build/onboard --parallel $(WORKERS)
	cd build/onboard && ctest --output-on-failure

clean:
	rm -rf $(VENV) out build dist
