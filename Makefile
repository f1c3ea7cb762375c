# Start with `make demo` and `make test`; both create their own environment first.
#   VENV=path      virtual environment to use or create (default: .venv)
#   PYTHON=python  the interpreter that creates it
#   SAMPLE=200 SEED=0  number and seed of the mutants of `make mutation`; SAMPLE=0 tries all of them (hours)
#   RESULTS=path   results folder that `make profile` reads
#   PEERS=path     environment of ORB-SLAM3 and pycolmap, which `make report` compares with
#   REPORT_ARGS="..."  arguments for experiments.report.run, e.g. REPORT_ARGS="--accept 'a stricter gate'"
#   PYTEST_ARGS="..."  further arguments for pytest, e.g. PYTEST_ARGS="tests/geometry -x"

PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?=
PEERS ?=
REPORT_ARGS ?=
SAMPLE ?= 200
SEED ?= 0
RESULTS ?= results/demo
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --constraint constraints.txt

# PYTHONPATH: document the sources here, even if another checkout is installed. The variable silences a notice of the theme.
MKDOCS := NO_MKDOCS_2_WARNING=1 PYTHONPATH=. $(BIN)/mkdocs

# Stamps: an environment is rebuilt only when its inputs have changed.
INSTALLED := $(VENV)/.torchslam-installed
INSTALLED_DEV := $(VENV)/.torchslam-installed-dev
INSTALLED_DOCS := $(VENV)/.torchslam-installed-docs
INSTALLED_MUTATION := $(VENV)/.torchslam-installed-mutation
INSTALLED_BENCHMARKS := $(VENV)/.torchslam-installed-benchmarks
INSTALLED_RELEASE := $(VENV)/.torchslam-installed-release
PYTHONS := 3.11 3.12 3.13 3.14

.PHONY: help demo test test-slow test-docs fuzz mutation lint types pythons format docs docs-serve benchmarks profile report wheel lock \
	sbom audit clean distclean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */\1\t/' | expand -t 14

demo: $(INSTALLED)  ## render a room, run SLAM on it, evaluate, draw and print a table
	$(BIN)/torchslam demo --output results/demo

test: lint  ## lint, then the tests
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 8 --dist loadfile $(PYTEST_ARGS)

test-slow: $(INSTALLED_DEV)  ## the tests that `make test` leaves out: half an hour
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 8 --dist loadfile -m slow $(PYTEST_ARGS)

test-docs: $(INSTALLED_DEV) $(INSTALLED_DOCS)  ## execute the code blocks of the documentation, all tutorials included
	$(BIN)/python -m pytest tests/docs -m 'slow or not slow' $(PYTEST_ARGS)

fuzz: $(INSTALLED_DEV)  ## feed tens of thousands of invalid inputs to every reader: each must be read rightly or refused within 10 s and 1 GB
	$(BIN)/python -m tests.fuzz

mutation: $(INSTALLED_MUTATION)  ## mutation testing of the system layer: how many mutants do the tests detect?
	$(BIN)/python -m tests.mutation --sample $(SAMPLE) --seed $(SEED)

lint: $(INSTALLED_DEV) types  ## ruff, mypy and the layers of pyproject.toml
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

types: $(INSTALLED_DEV)  ## mypy alone
	$(BIN)/mypy

pythons: $(INSTALLED_DEV)  ## mypy for every supported Python version
	for version in $(PYTHONS); do $(BIN)/mypy --python-version $$version || exit 1; done

format: $(INSTALLED_DEV)  ## format the sources
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(INSTALLED_DOCS)  ## build the documentation in site/
	$(MKDOCS) build --strict

docs-serve: $(INSTALLED_DOCS)  ## serve the documentation on http://127.0.0.1:8000 and rebuild it on changes
	$(MKDOCS) serve --strict

benchmarks: $(INSTALLED_BENCHMARKS)  ## timing and accuracy tables against other libraries
	$(BIN)/python -m experiments.benchmarks.features
	$(BIN)/python -m experiments.benchmarks.geometry
	$(BIN)/python -m experiments.benchmarks.solvers
	$(BIN)/python -m experiments.benchmarks.pose_graph
	$(BIN)/python -m experiments.benchmarks.bundle
	$(BIN)/python -m experiments.benchmarks.long_bundle
	$(BIN)/python -m experiments.benchmarks.bal
	$(BIN)/python -m experiments.benchmarks.relative_pose
	$(BIN)/python -m experiments.benchmarks.mapping
	$(BIN)/python -m experiments.benchmarks.clips

profile: $(INSTALLED)  ## milliseconds per stage of the run in RESULTS (results/demo)
	$(BIN)/python -m experiments.benchmarks.slam.stages $(RESULTS)

report: $(INSTALLED)  ## run the default command on all recordings, write docs/figures/report.json and its tables: 15 minutes
	$(BIN)/python -m experiments.report.run $(if $(PEERS),--peers $(PEERS)) $(REPORT_ARGS)

wheel: $(INSTALLED_RELEASE)  ## build wheel and source distribution in dist/ and check them
	rm -rf build dist/torchslam-*
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*.whl dist/*.tar.gz

lock: $(INSTALLED_RELEASE)  ## rewrite requirements-test.lock: versions and hashes of the test dependencies, without torch
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade --config-file requirements-test.toml \
		--constraints constraints.txt --no-emit-package torch --custom-compile-command 'make lock' \
		--group pyproject.toml:test --group pyproject.toml:lint pyproject.toml --output-file requirements-test.lock

sbom: $(INSTALLED_RELEASE)  ## write dist/torchslam.cdx.json: installed packages with versions and licenses (CycloneDX)
	mkdir -p dist
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --output-file dist/torchslam.cdx.json $(BIN)/python

# Strict: otherwise a package that could not be looked up would pass.
audit: $(INSTALLED_RELEASE)  ## list known vulnerabilities of the packages in the lock file and constraints.txt
	mkdir -p dist
	grep -hE '^[a-z0-9.-]+==' requirements-test.lock constraints.txt | sed 's/ *\\$$//' | sort -u > dist/audited.txt
	$(BIN)/pip-audit --strict --disable-pip --no-deps --progress-spinner off --requirement dist/audited.txt

clean:  ## remove results and caches, keep the environment
	rm -rf results build dist site mutants .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean  ## remove the environment too
	rm -rf .venv *.egg-info

$(BIN)/python:
	@echo 'creating the environment $(VENV)'
	@$(PYTHON) -m venv $(VENV)

# torch comes first, alone: the build named in constraints.txt then satisfies everything that depends on it.
# --group needs pip 25.1.
$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'installing torch, torchslam and their dependencies into $(VENV): a few minutes, once'
	@$(PIP) --upgrade 'pip>=25.1'
	@$(PIP) torch
	@$(PIP) --editable .
	@touch $@

$(INSTALLED_DEV): $(INSTALLED)
	@echo 'installing the test and lint tools into $(VENV): a minute, once'
	@$(PIP) --group test --group lint
	@touch $@

$(INSTALLED_MUTATION): $(INSTALLED_DEV)
	@echo 'installing the mutation testing tool into $(VENV): a minute, once'
	@$(PIP) --group mutation
	@touch $@

$(INSTALLED_DOCS): $(INSTALLED)
	@echo 'installing the documentation tools into $(VENV): a minute, once'
	@$(PIP) --editable '.[docs]'
	@touch $@

$(INSTALLED_BENCHMARKS): $(INSTALLED)
	@echo 'installing the benchmark dependencies into $(VENV): a minute, once'
	@$(PIP) --group benchmarks
	@touch $@

$(INSTALLED_RELEASE): $(INSTALLED)
	@echo 'installing the release tools into $(VENV): a minute, once'
	@$(PIP) --group release
	@touch $@
