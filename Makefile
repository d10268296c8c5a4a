.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help install dev demo test test-fast check types format docs figures figures-check \
  method clean

VENV ?= .venv
BIN := $(abspath $(VENV))/bin
INSTALLED := $(VENV)/.installed
DEVELOPED := $(VENV)/.developed
# Two processes; a worker that has run out of tests takes some of the other's.
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal
# Where torch for the CPU is; empty: take what pip finds.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 22

install: $(INSTALLED)  ## make .venv and install what a run needs into it

dev: $(DEVELOPED)  ## add what training, tests, lint and documentation need

demo: $(INSTALLED)  ## drive a street by day and again by night: the default detector against bow
	$(BIN)/vslam run --dataset synthetic --seq night --compare bow

test: $(DEVELOPED)  ## run the tests, then the built wheel in a clean environment
	$(PYTEST)
	$(BIN)/python tools/wheel_test.py

test-fast: $(DEVELOPED)  ## run the tests that are not marked slow: under two minutes
	$(PYTEST) -m 'not slow'

check: $(DEVELOPED)  ## check format, lint and types
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	@$(MAKE) --no-print-directory types

# mypy cannot follow the folders' mapping to vslam.* (pyproject.toml): it reads a plain installation.
types: $(DEVELOPED)  ## check types
	rm -rf build
	$(BIN)/python -m pip install --quiet --no-deps --target build/typecheck .
	cd build/typecheck && \
	  $(BIN)/mypy --config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache -p vslam -p vslam_lab

format: $(DEVELOPED)  ## format the code and repair what lint can
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

docs: $(DEVELOPED)  ## build the documentation site, warnings are errors: build/site/index.html
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site

figures: $(INSTALLED)  ## make the tables and figures of the documents: hours (FIGURES=quick: minutes)
	$(BIN)/python tools/figures.py $(if $(filter quick,$(FIGURES)),--quick)

figures-check: $(INSTALLED)  ## check that each has a stamp; list those of another version of the method
	$(BIN)/python tools/figures.py --check

method: $(DEVELOPED)  ## write the trajectories that METHOD_VERSION stands for
	WRITE_METHOD_REFERENCES=1 $(BIN)/python -m pytest -q tests/product/test_method_version.py

clean:  ## remove build products and caches (.venv, data and runs stay)
	rm -rf build dist vslam.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt
	@set -e; \
	if [ ! -x $(BIN)/python ]; then \
	  for python in $(PYTHON) python3.11 python3 python3.14 python3.13 python3.12; do \
	    if $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then break; fi; \
	    python=; \
	  done; \
	  if [ -z "$$python" ]; then \
	    echo 'vslam needs Python 3.11 or later: install it, or name one: make PYTHON=/path/to/python3' >&2; \
	    exit 1; \
	  fi; \
	  echo "$$python -m venv $(VENV)"; \
	  $$python -m venv $(VENV) || { \
	    echo "$$python has no venv module: install it (Debian, Ubuntu: python3-venv)" >&2; exit 1; }; \
	fi
	@echo 'Installing vslam into $(VENV): a minute or two'
	@$(BIN)/python -m pip install --quiet --no-compile -e . -c constraints.txt
	@touch $@

$(DEVELOPED): $(INSTALLED)
	@# PyPI's torch for Linux brings gigabytes of CUDA; the CPU's build has an index of its own.
	@if [ -n "$(TORCH_INDEX)" ] && $(BIN)/python -m pip install --quiet --dry-run --no-deps \
	    --report - torch -c constraints.txt | grep -qE '"(nvidia|cuda)-'; then \
	  $(BIN)/python -m pip install --quiet --no-deps --retries 0 --timeout 20 \
	    torch -c constraints.txt --index-url $(TORCH_INDEX) 2>/dev/null || \
	    echo "$(TORCH_INDEX) does not answer: torch comes from PyPI, with gigabytes of CUDA" >&2; \
	fi
	@echo 'Installing torch and the tools of development into $(VENV): a few minutes'
	@$(BIN)/python -m pip install --quiet --no-compile -e '.[dev]' -c constraints.txt
	@touch $@
