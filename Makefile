# Everything runs in .venv, which the first target creates. Nothing is fetched once it stands.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
LATEST := build/latest
# One torch thread per worker: two workers with a thread pool each would fight over two cores.
# All tests of a file run in one worker, which makes the file's fixtures once.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest

.DEFAULT_GOAL := help
.PHONY: help demo install test test-faults test-processors test-slow test-latest check docs linkcheck format bench clean

help:
	@echo "make demo       install, then run the demonstration"
	@echo "make install    create .venv and install the pinned versions"
	@echo "make test       every test but the learning tests"
	@echo "make test-processors  the tests of trajectories with the kernels and roundings of other processors"
	@echo "make test-faults  whether the tests catch plausible faults of the library"
	@echo "make test-latest  the same with the newest packages that pyproject.toml admits"
	@echo "make test-slow  the learning tests"
	@echo "make check      format, lint, types, doctests"
	@echo "make docs       the documentation, in docs/_build/html"
	@echo "make linkcheck  whether the sites that it links to are there"
	@echo "make format     rewrite the code as 'make check' wants it"
	@echo "make bench      throughput measurements"
	@echo "make clean      remove builds and caches (.venv and runs stay)"

install: $(STAMP)

# torch and the build back end first: torch is the one large download, and with setuptools in place
# the editable install needs no isolated build environment, so it uses the pinned one.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt torch setuptools wheel
	$(BIN)/python -m pip install --quiet -c constraints.txt --no-build-isolation -e '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/torchrl-mcp-demo

test: $(STAMP)
	$(PYTEST) -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

# The tests whose outcome is chaotic, as on processors that are not at hand: half an hour.
PERTURBATIONS ?= 20
test-processors: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python tests/support/processors.py --perturbations $(PERTURBATIONS)

# Two hundred faults, one at a time: half an hour.
test-faults: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python tests/support/faults.py

test-slow: $(STAMP)
	$(PYTEST) -n 2 --dist loadfile --no-loadscope-reorder -m slow

# An environment of its own, without the pins.
test-latest:
	$(PYTHON) -m venv --clear $(LATEST)
	$(LATEST)/bin/python -m pip install --quiet torch setuptools wheel
	$(LATEST)/bin/python -m pip install --quiet --no-build-isolation -e '.[dev,warp]'
	$(LATEST)/bin/python -m pip freeze --exclude-editable
	OMP_NUM_THREADS=1 $(LATEST)/bin/pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

# Doctests leave out what imports an extra that need not be there.
check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy -p torchrl_mcp
	$(PYTEST) --doctest-modules --ignore-glob='*/physics/warp.py' torchrl_mcp

DOCS := .venv/.docs
$(DOCS): $(STAMP)
	$(BIN)/python -m pip install --quiet -c constraints.txt --no-build-isolation -e '.[docs]'
	touch $@

docs: $(DOCS)
	$(BIN)/python -m sphinx -E -W --keep-going -b html docs docs/_build/html

linkcheck: $(DOCS)
	$(BIN)/python -m sphinx -E -b linkcheck docs docs/_build/linkcheck

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	for name in throughput training_throughput; do $(BIN)/python benchmarks/$$name.py || exit 1; done

clean:
	rm -rf build dist docs/_build .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find torchrl_mcp envs conf tests benchmarks -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true
