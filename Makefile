# make train: from a fresh clone to a trained policy. make test: everything that CI checks. make test-full: the long
# tests too, and how much of the package they run.
# ARGS passes overrides on: make train ARGS="task=cartpole_balance seed=2"

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=
# Whole files go to one worker, since their tests share envs and compiled kernels.
PARALLEL := -n auto --maxprocesses 4 --dist loadfile
# Pyright takes as long as all other checks. Each writes its lines at its end, where make can do so.
CHECKS := check docs --no-print-directory -j 2 $(if $(filter output-sync,$(.FEATURES)),--output-sync)

.PHONY: setup train check lint types imports house headers docs test test-full test-oldest test-newest dist figures clean

setup: $(STAMP)

# The pinned versions are installed once; later calls cost nothing until the dependencies change.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed; choose one with: make setup PYTHON=python3.11"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing what ksim_rl needs, several minutes where nothing is cached"
	@test -t 1 || while sleep 15; do echo "still installing"; done & ticking=$$!; \
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"; code=$$?; kill $$ticking 2>/dev/null; exit $$code
	@touch $@

train: setup
	$(BIN)/ksim-rl train $(if $(findstring task=,$(ARGS)),,task=pendulum_swingup) $(ARGS)

check: lint types imports house headers

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/pyright

imports: setup
	$(BIN)/lint-imports

house: setup
	$(BIN)/python -m tests.house

# C++ compiles header by header, where there is a compiler.
headers: setup
	$(BIN)/python -m tests.headers

# Warnings, such as links that lead nowhere, are errors (with --quiet they would not be).
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

test: setup
	$(MAKE) $(CHECKS)
	$(BIN)/python -m pytest $(PARALLEL) $(ARGS)

test-full: setup
	$(MAKE) $(CHECKS)
	$(BIN)/python -m pytest $(PARALLEL) -m "full or not full" --cov --cov-report=term $(ARGS)

# The tests with the oldest, or with the newest, versions that pyproject.toml allows, in a venv of their own.
test-oldest test-newest: test-%:
	@test -x .venv-$*/bin/python || $(PYTHON) -m venv .venv-$*
	.venv-$*/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager $(if $(filter oldest,$*),-c constraints-oldest.txt) -e ".[dev]"
	.venv-$*/bin/python -m pip freeze
	.venv-$*/bin/python -m pytest $(PARALLEL) $(ARGS)

# sdist and wheel, under dist/.
dist: setup
	$(BIN)/python -m build --no-isolation --outdir dist .

# Committed figures that are older than the files which they measure, with the commands that renew them.
figures: setup
	$(BIN)/python -m benchmarks.figures

clean:
	rm -rf build dist site .coverage .pytest_cache .ruff_cache .import_linter_cache
