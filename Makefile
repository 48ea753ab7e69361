# Everything is kept in .venv inside this folder; nothing but Python 3.11 or newer and make is needed.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.PHONY: demo test test-all test-lowest bench lint docs quick-start clean

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed.stamp
TYPES := $(VENV)/types.stamp
LOWEST := .venv-lowest

# The first interpreter that is new enough and can make virtual environments.
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
	$$p -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

# One line, rewritten in place, shows where pip is.
PIP_PROGRESS := awk '/^ *(Collecting|Downloading|Installing)/ { \
	printf "\r\033[K  %.76s", $$1 " " $$2; fflush() } END { printf "\r\033[K" }'

# What commands import. Python compiles the rest where it is used; all of it would take pip longer than its downloads.
IMPORTED := numpy scipy numba llvmlite h5py cv2 matplotlib pydantic PIL meshio tqdm

demo: $(INSTALLED)
	@echo "make demo: builds a model, films it, tracks it; minutes the first time, later runs use what is there"
	@$(BIN)/python examples/demo/run.py

# Each file of tests runs in one of two processes. What Python and numba compile for the tests is kept for all processes
# that they begin, wherever Python is asked to write none, and outlives `make clean`.
COMPILED := PYTHONDONTWRITEBYTECODE= PYTHONPYCACHEPREFIX=$(CURDIR)/$(VENV)/pycache NUMBA_CACHE_DIR=$(CURDIR)/$(VENV)/numba
PYTEST := $(COMPILED) $(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder
# A test that takes so many seconds hangs: it fails, and where each of its threads stands is printed.
NONE_HANGS := -o faulthandler_timeout=900 -o faulthandler_exit_on_timeout=true --max-worker-restart 1

# `morph doctor` compiles the inner loops of tracking once, before two processes would each do so. Lint runs beside it and
# the tests, which leave a core free now and then; what it finds is printed after them.
TEST_AND_LINT = $(MAKE) --no-print-directory lint > $(VENV)/lint.log 2>&1 & lint=$$!; status=0; \
	echo "compiling the inner loops of tracking (a minute or two the first time)"; \
	$(COMPILED) $(BIN)/morph doctor > $(VENV)/doctor.log 2>&1 || cat $(VENV)/doctor.log; \
	$(1) || status=$$?; wait $$lint || status=$$?; cat $(VENV)/lint.log; exit $$status

test: $(INSTALLED)
	@$(call TEST_AND_LINT,$(PYTEST) -m "not slow" $(NONE_HANGS))

test-all: $(INSTALLED)
	@$(call TEST_AND_LINT,$(PYTEST))

# The unit tests with the oldest versions that pyproject.toml allows, in an environment of their own.
# The oldest Matplotlib calls pyparsing by names that newer ones warn of.
test-lowest:
	@test -x $(LOWEST)/bin/python || $(PYTHON) -m venv $(LOWEST)
	@sed -nE 's/^[^"]*"([A-Za-z0-9_.-]+)(\[[a-z]+\])?>=([0-9.]+).*/\1==\3.*/p' pyproject.toml | sort -u > $(LOWEST)/lowest.txt
	@echo 'pyparsing<3.2' >> $(LOWEST)/lowest.txt
	@$(LOWEST)/bin/python -m pip install --disable-pip-version-check --progress-bar off \
		--constraint $(LOWEST)/lowest.txt --editable '.[dev]' | $(PIP_PROGRESS)
	@NUMBA_CACHE_DIR=$(CURDIR)/$(LOWEST)/numba $(LOWEST)/bin/pytest -q -n 2 --dist loadfile tests/unit

bench: $(INSTALLED)
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python "$$script"; done

lint: $(INSTALLED) $(TYPES)
	@$(BIN)/ruff format --check --quiet
	@$(BIN)/ruff check --quiet
	@$(BIN)/lint-imports

# Types are checked where a module has changed, come or gone since they were found right: that takes minutes. What is
# edited meanwhile is checked the next time.
$(TYPES): $(INSTALLED) $(shell find src -name '*.py' -o -type d -not -name __pycache__)
	@touch $@.begun
	@$(BIN)/pyright --warnings
	@mv $@.begun $@

# The site, in build/site: open build/site/index.html. Pictures of the studio follow its pages where Chromium is present.
docs: $(INSTALLED)
	@$(BIN)/python docs/studio_pictures.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "the documentation is in build/site/index.html"

# The wheel, installed in an environment of its own, runs the quick start outside of this folder.
quick-start:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer, with its venv module, is needed"; exit 1; }
	@rm -rf build/wheel && mkdir -p build/wheel/run
	@$(PYTHON) -m venv build/wheel/venv
	@build/wheel/venv/bin/pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir build/wheel .
	@build/wheel/venv/bin/pip install --quiet --disable-pip-version-check "$$(ls build/wheel/*.whl)[demo]"
	@cd build/wheel/run && MORPH=../venv/bin/morph ../venv/bin/python ../../../docs/run_quick_start.py

clean:
	rm -rf demo examples/*/output build dist .pytest_cache .ruff_cache .import_linter_cache
	find src tests examples -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer, with its venv module, is needed: no such python3 was found"; exit 1; }
	@echo "Installing into $(VENV) with $(PYTHON) (a few minutes, once)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off --no-compile \
		--editable '.[dev,docs,rerun]' | $(PIP_PROGRESS)
	@cd $(VENV)/lib/python*/site-packages && $(CURDIR)/$(BIN)/python -m compileall -q -j 0 $(CURDIR)/src $(IMPORTED)
	@touch $@
