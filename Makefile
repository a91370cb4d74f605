# Two commands are all a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
# parallel test workers
WORKERS ?= 2
# markers of those that `make test` runs; tests/thorough.txt lists what takes long
MARKS = not slow and not dataset and not thorough
# folder of recordings for `make bench`; what is not there is left out
RECORDINGS ?= ../shared/data
# where `make reliability` writes its JSON
RESULTS ?= benchmarks/results
# folder of the locked versions; `LOCK=` takes the newest that pyproject.toml allows
LOCK ?= requirements
PIP := -m pip --quiet --disable-pip-version-check
# most of what is installed is never imported: Python compiles the rest when it first is, and keeps it
INSTALL := $(PIP) install --no-compile
unexport PYTHONDONTWRITEBYTECODE

# $(call install,VENV,EXTRA): what EXTRA needs, each file by its hash, then the project
install = $(if $(LOCK),\
  $(1)/bin/python $(INSTALL) --requirement $(LOCK)/$(2).lock --require-hashes && \
  $(1)/bin/python $(INSTALL) --no-deps --no-build-isolation --editable .,\
  $(1)/bin/python $(INSTALL) --editable '.[$(2)]')

# Minutes; they touch every dependency: logs, store, two epochs, resume, export, readers, pages
QUICK := $(addprefix tests/train/test_loop.py::test_,resume_is_bitwise run_writes_what_it_should \
  exported_values_are_the_trainers) \
  tests/data/formats/test_conformance.py tests/data/store/test_dataset.py \
  tests/data/test_import_elsewhere.py::test_no_cluster_is_one_line \
  tests/evaluation/test_baselines.py::test_cma_es_finds_the_minimum_of_a_shifted_sphere \
  tests/export/test_forms.py tests/export/test_weights.py \
  tests/features/test_features.py::test_equals_the_oracle tests/report/test_data_page.py
QUICKLY = -m pytest -q -m "not slow and not dataset" $(QUICK)
# with other versions: compiled quickly, and no files of damaged bytes
OTHERS = XLA_FLAGS="--xla_backend_optimization_level=0 $(XLA_FLAGS)"
UNDAMAGED = -k "not changed_bytes and not damaged_files"

# Features, gradients, resume, recordings, and what rounds otherwise when compiled quickly, with
# the compiler as users have it. For the rest XLA compiles in half the time to slower programs;
# by hand and in `make reliability` all have the users' compiler, but for what `tests/helpers/commands.py`
# and `tests/train/test_processes.py` start
EXACT := $(addprefix tests/,evaluation/test_recorded_training.py \
  features/test_features.py reward/test_gradients.py \
  evaluation/test_baselines.py::test_distances_alone_are_those_of_the_scores \
  $(addprefix train/test_,loop.py::test_every_scene_counts_once_for_the_normaliser \
    loop.py::test_resume_is_bitwise \
    step.py::test_candidates_of_a_scene_do_not_depend_on_the_batch \
    step.py::test_either_future_is_learned_from \
    step.py::test_densities_are_of_the_candidates_that_count \
    step.py::test_a_hard_negative_is_never_the_positive_nor_better_than_it))
QUICK_XLA = --xla_backend_optimization_level=0 $(NO_EMITTERS)
# halves the time of compiling; jaxlib from 0.11 on aborts at a flag that it no longer has
NO_EMITTERS = $(shell $(BIN)/python -c 'import jaxlib; print("--xla_cpu_use_fusion_emitters=false" \
  if int(jaxlib.__version__.split(".")[1]) < 11 else "")')
TEST = $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal -m "$(MARKS)"

.PHONY: demo test test-all test-slow test-long test-dataset test-floor test-ceiling lint bench results docs notebooks onboard
.PHONY: setup
.PHONY: lock audit wheel clean reliability fuzz accelerator

setup: $(VENV)/.installed

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON): Python >= 3.11 is needed (set PYTHON=...)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

# What users need, and what the tests need besides
$(VENV)/.all: pyproject.toml $(if $(LOCK),$(LOCK)/all.lock) | $(BIN)/python
	$(call install,$(VENV),all)
	@touch $@

$(VENV)/.installed: pyproject.toml $(if $(LOCK),$(LOCK)/test.lock) | $(BIN)/python
	$(call install,$(VENV),test)
	@touch $(VENV)/.all $@

# The main job, end to end, on an excerpt of US-101: import, train, rank, simulate, gate, report.
# Most of its time is compiling, which is a third shorter without XLA's fusion emitters.
demo: $(VENV)/.all
	XLA_FLAGS="$(NO_EMITTERS) $(XLA_FLAGS)" $(BIN)/rcirl autotune --input=data_specs/demo/us101.csv.gz \
	  --source=data_specs/demo/us101.toml --recipe=quick --output=$(OUT) --cases=4 --duration=20 --drives=40

test: setup
	$(TEST) $(EXACT)
	XLA_FLAGS="$(QUICK_XLA) $(XLA_FLAGS)" $(TEST) $(addprefix --deselect=,$(EXACT))

# All but `slow`, with those on recordings where they are
test-all:
	$(MAKE) test MARKS="not slow$(if $(RCIRL_DATA)$(wildcard ../shared/data),, and not dataset)"

test-dataset: MARKS = dataset and not slow
test-dataset: setup
	$(TEST)

# Killed processes, lost Ray nodes, memory, folds, the tutorial as written; one at a time.
# Those with the marker `dataset` want the recordings as well
test-slow: setup
	$(BIN)/python -m pytest -q -m "slow and not long"

# The long rows of docs/reliability.md, each by its command; hours, and `make fuzz` wants clang
test-long: setup
	$(BIN)/python -m pytest -q -m long

# The quick tests with the oldest versions allowed; they run among newer neighbours that
# announce changes to come, so such announcements are no errors here
test-floor: build/floor/.installed
	$(OTHERS) build/floor/bin/python $(QUICKLY) $(UNDAMAGED) -W default::DeprecationWarning

build/floor/.installed: pyproject.toml requirements/floor.lock
	rm -rf build/floor
	$(PYTHON) -m venv build/floor
	build/floor/bin/python $(INSTALL) --require-hashes --requirement requirements/floor.lock
	build/floor/bin/python $(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $@

# The quick tests with the newest versions allowed, whatever is locked
test-ceiling:
	rm -rf build/ceiling
	$(PYTHON) -m venv build/ceiling
	build/ceiling/bin/python $(INSTALL) --editable '.[quick]'
	$(OTHERS) build/ceiling/bin/python $(QUICKLY) $(UNDAMAGED)

# Source distribution, a wheel made of it, and far from this folder, in an environment of what the
# wheel itself asks for, in the locked versions: the help of every command without any extra, and the
# quick tests with the extra `quick`. What it does not name is not there. Versions without hashes: pip wants hashes of all or of none, and the wheel has none
wheel: setup
	rm -rf dist
	$(BIN)/python -m hatchling build --target sdist
	$(BIN)/python $(PIP) wheel --no-deps --no-build-isolation --wheel-dir dist dist/*.tar.gz
	wheel=$$(realpath dist/*.whl) lock=$$(realpath $(LOCK)/test.lock) away=$$(mktemp -d); \
	  trap 'rm -rf "$$away"' EXIT; set -e; \
	  $(BIN)/python -m venv $$away/venv; cp -R tests pyproject.toml $$away; cd $$away; \
	  sed -n 's/^\([a-z0-9].*[^ ]\) *\\$$/\1/p' $$lock > locked.txt; \
	  venv/bin/python $(INSTALL) --constraint locked.txt "$$wheel"; \
	  for name in $$(venv/bin/python -c 'from rcirl_jax.cli.rcirl import COMMANDS as x; print(*x)'); do \
	    venv/bin/rcirl $$name --help > $$name.txt; done; \
	  venv/bin/python $(INSTALL) --constraint locked.txt "$$wheel[quick]"; \
	  venv/bin/python -m pip check; \
	  venv/bin/python -c 'import rcirl_jax as r; print(r.__file__)'; \
	  venv/bin/python $(QUICKLY)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/pyright
	$(BIN)/lint-imports

$(VENV)/.bench: pyproject.toml | setup
	$(BIN)/python $(INSTALL) --editable '.[bench]'
	@touch $@

# All benchmarks, three quarters of an hour; wants a quiet machine. Writes benchmarks/results and
# the pictures of docs/performance.md.
bench: export JAX_PLATFORMS = cpu
bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.sweep
	$(BIN)/python -m benchmarks.suite
	taskset -c 0 $(BIN)/python -m benchmarks.dp
	taskset -c 0 $(BIN)/python -m benchmarks.single_plan
	taskset -c 0 $(BIN)/python -m benchmarks.onboard
	$(BIN)/python -m benchmarks.importing --data=$(RECORDINGS)
	$(BIN)/python -m benchmarks.paper_scale
	$(BIN)/python -m benchmarks.plots

# The files that docs/results.md cites, from the datasets in out/, cheapest first; it says for how
# many hours, and goes on where it was
results: setup
	$(BIN)/python -m benchmarks.remake && $(BIN)/python -m benchmarks.tables

# Everything that an accelerator is asked, in eight minutes, with the Python and JAX that are
# there (`PYTHON=python3.12`): nothing is downloaded or built. `SMALL=--small` rehearses it on a CPU
accelerator:
	@$(PYTHON) -c 'import jax, flax, optax' 2>/dev/null || \
	  { echo "error: $(PYTHON): no jax, flax or optax: expected PYTHON=.venv/bin/python or another with them"; exit 1; }
	$(PYTHON) -m benchmarks.accelerator $(SMALL) --output=$(RESULTS)

# Documentation as a site; warnings are errors
docs: export NO_MKDOCS_2_WARNING = 1
docs: setup
	$(BIN)/python -m mkdocs build --strict --quiet
	@echo "site: build/site/index.html"

# docs/notebooks run anew, with their outputs but not their progress bars; compiled as `make test` does
notebooks: export PYTHONPATH = .
notebooks: export XLA_FLAGS = $(QUICK_XLA)
notebooks: setup
	$(BIN)/python -m tests.docs.notebooks

# C++ reader; needs cmake, a C++17 compiler and libmsgpack-dev
onboard:
	cmake -S onboard -B build/onboard -DRCIRL_WERROR=ON
	cmake --build build/onboard --parallel $(WORKERS)
	cd build/onboard && ctest --output-on-failure

# Locked versions anew, for every Python and platform at once; `UPGRADE=` keeps what still fits
UPGRADE ?= --upgrade
lock: export UV_CUSTOM_COMPILE_COMMAND = make lock
lock: COMPILE = build/tools/bin/uv pip compile --quiet $(UPGRADE) --universal --python-version 3.11 \
  --generate-hashes --only-binary :all: --emit-build-options --no-emit-index-url --no-annotate
lock: PROJECT = pyproject.toml requirements/build.in
lock: build/tools/.installed
	$(COMPILE) $(PROJECT) --extra test --output-file requirements/test.lock
	$(COMPILE) $(PROJECT) --extra all --constraint requirements/test.lock --output-file requirements/all.lock
	$(COMPILE) $(PROJECT) --extra quick --resolution lowest-direct --output-file requirements/floor.lock
	$(COMPILE) requirements/tools.in --output-file requirements/tools.lock

build/tools/.installed: $(if $(LOCK),$(LOCK)/tools.lock,requirements/tools.in)
	$(PYTHON) -m venv build/tools
	build/tools/bin/python $(INSTALL) --requirement $<
	@touch $@

# Known vulnerabilities of the locked versions; `AUDIT=--vulnerability-service=osv` asks elsewhere
audit: build/tools/.installed
	build/tools/bin/python .ci/audit.py $(AUDIT) $(addprefix requirements/,all.lock test.lock tools.lock)

# Every row of docs/reliability.md that has not come out as stated with this code before;
# `MINUTES=2` leaves out what takes longer, `ANEW=1` runs all. Rows that depend on what others
# publish, audit and test-ceiling, are run each time
reliability: setup
	$(BIN)/python -m benchmarks.reliability.table $(if $(MINUTES),--minutes=$(MINUTES)) $(if $(ANEW),--anew) --output=$(RESULTS)

# The C++ reader and F under libFuzzer; needs clang and its runtime
FUZZ_SECONDS ?= 720
# fewer than these are a failure
FUZZ_INPUTS ?= 1000000
FUZZ_FEATURES ?= 50000
fuzz: setup
	$(BIN)/python -m onboard.fuzz.make_corpus --output=out/fuzz/corpus
	cmake -S onboard -B build/fuzz -DCMAKE_CXX_COMPILER=clang++ -DRCIRL_BUILD_FUZZ=ON
	cmake --build build/fuzz --target fuzz_load fuzz_features fuzz_scene
	$(BIN)/python -m onboard.fuzz.counted $(FUZZ_INPUTS) build/fuzz/fuzz_load \
	  -dict=out/fuzz/weights.dict -max_len=16384 -timeout=10 \
	  -max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 out/fuzz/corpus
	mkdir -p out/fuzz/features out/fuzz/scene
	$(BIN)/python -m onboard.fuzz.counted $(FUZZ_FEATURES) build/fuzz/fuzz_features \
	  -max_len=8192 -len_control=0 -timeout=10 -max_total_time=$(FUZZ_SECONDS) out/fuzz/features
	$(BIN)/python -m onboard.fuzz.counted $(FUZZ_FEATURES) build/fuzz/fuzz_scene \
	  -max_len=4096 -len_control=0 -timeout=10 -max_total_time=$(FUZZ_SECONDS) out/fuzz/scene

clean:
	rm -rf $(VENV) out build dist
