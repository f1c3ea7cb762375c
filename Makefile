# The two commands a newcomer needs are `make demo` and `make test`; both make their own environment first.
#   VENV=path      use (or create) another virtual environment than .venv
#   PYTHON=python  the interpreter that creates it
#   SAMPLE=200 SEED=0  how many changes `make mutation` tries, and which; SAMPLE=0 tries all: hours
#   RESULTS=path   the folder of results that `make profile` reads
#   REPORT_ARGS="..."  arguments for experiments.report.run, e.g. REPORT_ARGS="shelf_bin --accept 'a stricter gate'"
#   PYTEST_ARGS="..."  further arguments for pytest, e.g. PYTEST_ARGS="tests/geometry -x"

PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?=
REPORT_ARGS ?=
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
INSTALLED_RELEASE := $(VENV)/.torchslam-installed-release
PYTHONS := 3.11 3.12 3.13 3.14

.PHONY: help demo test test-docs fuzz mutation lint types pythons format docs docs-serve benchmarks profile report wheel lock \
	sbom audit clean distclean
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

mutation: $(INSTALLED_MUTATION)  ## small changes to the system layer: how many of them do the tests notice?
	$(BIN)/python -m tests.mutation --sample $(SAMPLE) --seed $(SEED)

lint: $(INSTALLED_DEV) types  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED_DEV)  ## mypy alone
	$(BIN)/mypy

pythons: $(INSTALLED_DEV)  ## mypy for every Python that the package promises
	for version in $(PYTHONS); do $(BIN)/mypy --python-version $$version || exit 1; done

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

report: $(INSTALLED_BENCHMARKS)  ## all sequences and the quick benchmarks: one line more in docs/figures/history.jsonl, drawn
	$(BIN)/python -m experiments.report.run $(REPORT_ARGS)

wheel: $(INSTALLED_RELEASE)  ## wheel and source distribution, in dist/
	$(BIN)/python -m build

lock: $(INSTALLED_RELEASE)  ## requirements-test.lock anew: what the tests need, by version and hash, but torch
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade --config-file requirements-test.toml \
		--constraints constraints.txt --no-emit-package torch --custom-compile-command 'make lock' \
		--group pyproject.toml:test --group pyproject.toml:lint pyproject.toml --output-file requirements-test.lock

sbom: $(INSTALLED_RELEASE)  ## dist/torchslam.cdx.json: all that is installed, with versions and licences (CycloneDX)
	mkdir -p dist
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --output-file dist/torchslam.cdx.json $(BIN)/python

# Strict: a package that could not be looked up would otherwise pass as one without fault.
audit: $(INSTALLED_RELEASE)  ## known vulnerabilities in what the lock file and constraints.txt name
	mkdir -p dist
	grep -hE '^[a-z0-9.-]+==' requirements-test.lock constraints.txt | sed 's/ *\\$$//' | sort -u > dist/audited.txt
	$(BIN)/pip-audit --strict --disable-pip --no-deps --progress-spinner off --requirement dist/audited.txt

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
	@$(PIP) --editable '.[docs]'
	@touch $@

$(INSTALLED_BENCHMARKS): $(INSTALLED)
	@echo 'installing the peers for the benchmarks into $(VENV): a minute, once'
	@$(PIP) --group benchmarks
	@touch $@

$(INSTALLED_RELEASE): $(INSTALLED)
	@echo 'installing the tools for releases into $(VENV): a minute, once'
	@$(PIP) --group release
	@touch $@
