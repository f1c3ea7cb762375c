# The two commands a newcomer needs are `make demo` and `make test`; both make their own environment first.
#   VENV=path      use (or create) another virtual environment than .venv
#   PYTHON=python  the interpreter that creates it
#   SAMPLE=200 SEED=0  how many changes `make mutation` tries, and which; SAMPLE=0 tries all: hours
#   RESULTS=path   the folder of results that `make profile` reads
#   PYTEST_ARGS="..."  further arguments for pytest, e.g. PYTEST_ARGS="tests/geometry -x"

PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?=
SAMPLE ?= 200
SEED ?= 0
RESULTS ?= results/demo
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --constraint constraints.txt

# From the sources here, wherever another checkout is installed. The theme's word about its own future is none of ours.
MKDOCS := NO_MKDOCS_2_WARNING=1 PYTHONPATH=. $(BIN)/mkdocs

# Stamps: an environment is made again only when what it is made from has changed.
INSTALLED := $(VENV)/.torchslam-installed
INSTALLED_DEV := $(VENV)/.torchslam-installed-dev
INSTALLED_DOCS := $(VENV)/.torchslam-installed-docs
INSTALLED_MUTATION := $(VENV)/.torchslam-installed-mutation
INSTALLED_BENCHMARKS := $(VENV)/.torchslam-installed-benchmarks

.PHONY: help demo test test-docs fuzz mutation lint types format docs docs-serve benchmarks profile clean distclean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */\1\t/' | expand -t 14

demo: $(INSTALLED)  ## render a room, run SLAM on it, evaluate, draw and print a table
	$(BIN)/torchslam demo --output results/demo

test: lint  ## lint, then the tests
	$(BIN)/python -m pytest $(PYTEST_ARGS)

test-docs: $(INSTALLED_DEV) $(INSTALLED_DOCS)  ## run all that the documentation says can be run: every tutorial
	$(BIN)/python -m pytest tests/docs -m 'slow or not slow' $(PYTEST_ARGS)

fuzz: $(INSTALLED_DEV)  ## 30,000 wrong inputs to everything that reads: each is read or refused, in 10 s and 1 GB
	$(BIN)/python -m tests.fuzz

mutation: $(INSTALLED_MUTATION)  ## small changes to the system layer: how many of them do its tests notice?
	$(BIN)/python -m tests.mutation --sample $(SAMPLE) --seed $(SEED)

lint: $(INSTALLED_DEV) types  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED_DEV)  ## mypy alone
	$(BIN)/mypy

format: $(INSTALLED_DEV)  ## rewrite the sources in the house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(INSTALLED_DOCS)  ## the documentation, as pages in site/
	$(MKDOCS) build --strict

docs-serve: $(INSTALLED_DOCS)  ## the documentation on http://127.0.0.1:8000, made again whenever it changes
	$(MKDOCS) serve --strict

benchmarks: $(INSTALLED_BENCHMARKS)  ## the timing and accuracy tables against the peers
	$(BIN)/python -m experiments.benchmarks.features
	$(BIN)/python -m experiments.benchmarks.geometry
	$(BIN)/python -m experiments.benchmarks.solvers
	$(BIN)/python -m experiments.benchmarks.pose_graph
	$(BIN)/python -m experiments.benchmarks.bundle
	$(BIN)/python -m experiments.benchmarks.relative_pose
	$(BIN)/python -m experiments.benchmarks.mapping
	$(BIN)/python -m experiments.benchmarks.clips

profile: $(INSTALLED)  ## milliseconds by stage of the run in RESULTS (results/demo)
	$(BIN)/python -m experiments.benchmarks.slam.stages $(RESULTS)

clean:  ## remove results and caches, keep the environment
	rm -rf results build dist site mutants .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean  ## remove the environment too
	rm -rf .venv *.egg-info

$(BIN)/python:
	@echo 'making the environment $(VENV)'
	@$(PYTHON) -m venv $(VENV)

# torch comes first, alone: the build named in constraints.txt then satisfies everything that depends on it.
# pip learned --group in 25.1.
$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'installing torch, torchslam and what they need into $(VENV): some minutes, once'
	@$(PIP) --upgrade 'pip>=25.1'
	@$(PIP) torch
	@$(PIP) --editable .
	@touch $@

$(INSTALLED_DEV): $(INSTALLED)
	@echo 'installing the tools for tests and lint into $(VENV): a minute, once'
	@$(PIP) --group test --group lint
	@touch $@

$(INSTALLED_MUTATION): $(INSTALLED_DEV)
	@echo 'installing the tool for mutation testing into $(VENV): a minute, once'
	@$(PIP) --group mutation
	@touch $@

$(INSTALLED_DOCS): $(INSTALLED)
	@echo 'installing the tools for the documentation into $(VENV): a minute, once'
	@$(PIP) --group docs
	@touch $@

$(INSTALLED_BENCHMARKS): $(INSTALLED)
	@echo 'installing the peers for the benchmarks into $(VENV): a minute, once'
	@$(PIP) --group benchmarks
	@touch $@
