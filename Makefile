# `make run` flies a swarm, `make test` runs the tests: each does all the set-up that it needs.
PYTHON ?= python3
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest --numprocesses=logical --maxprocesses=4 --dist=loadfile
export OPENBLAS_NUM_THREADS := 1

.PHONY: run test viz paper check bench decidable starts networks formations fuzz schedules soak lock clean
.DEFAULT_GOAL := help

help:
	@echo "make run    fly the paper's first experiment with seven MAVs"
	@echo "make test   run the tests"
	@echo "make viz    install the 3-D viewer, for swarm view and swarm run --view (0.8 GB)"
	@echo "make paper  the paper's experiments, ten seeds each, as one page (runs/paper/paper.html; 15 to 30 minutes)"
	@echo "make check  import contracts, formatting, types and tests"
	@echo "make bench  time one station update against the plain one, N = 3..9, and a plan (runs/bench.json, runs/planning.json)"
	@echo "make decidable  measure which starts can be decided (deploy/pictures/decidable.png)"
	@echo "make starts  the table of starts, 200 seeds a row, hours (runs/starts; SEEDS=0:20 ROWS='box_7 line' for less)"
	@echo "make networks  the table of faults, ten seeds a row, half an hour (runs/networks.md; SEEDS=0:2)"
	@echo "make formations  the table of flights on board, half an hour (runs/formations; SEEDS=0:2 ROWS=line)"
	@echo "make fuzz   100,000 hostile messages to one agent (runs/fuzz.json)"
	@echo "make schedules  a thousand random fault schedules (runs/schedules.json; SEEDS=0:100 for some)"
	@echo "make soak   ten minutes of random kills and stops (runs/soak.json; SECONDS=60 for a short one)"
	@echo "make lock   renew the requirements*.lock from pyproject.toml"

run: .venv/ready
	$(BIN)/swarm run paper_run_1

test: .venv/ready-to-test
	$(PYTEST)

viz: .venv/ready-to-view

paper: .venv/ready
	$(BIN)/swarm report --paper

check: .venv/ready-to-test
	$(BIN)/lint-imports
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(PYTEST)

bench: .venv/ready-to-test
	$(BIN)/python -m tests.bench.station_update
	$(BIN)/python -m tests.bench.planning

decidable: .venv/ready-to-test
	$(BIN)/python -m tests.bench.decidable

fuzz: .venv/ready-to-test
	$(BIN)/python -m tests.bench.fuzz

starts: .venv/ready-to-test
	$(BIN)/python -m tests.bench.starts $(or $(SEEDS),0:200) $(ROWS)

networks: .venv/ready-to-test
	$(BIN)/python -m tests.bench.networks $(or $(SEEDS),0:10)

formations: .venv/ready-to-test
	$(BIN)/python -m tests.bench.formations "$(SEEDS)" $(ROWS)

schedules: .venv/ready-to-test
	$(BIN)/python -m tests.bench.schedules $(or $(SEEDS),0:1000)

SECONDS ?= 600
soak: .venv/ready-to-test
	$(BIN)/python -m tests.bench.soak $(SECONDS)

.venv/uv:
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "uv>=0.5"
	touch $@

.venv/ready: .venv/uv requirements.lock pyproject.toml
	$(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable .
	touch $@

.venv/ready-to-test: .venv/ready requirements-test.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements-test.lock
	touch $@

.venv/ready-to-view: .venv/ready requirements-viz.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements-viz.lock
	touch $@

lock: .venv/uv
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-header --python-version 3.11 \
		--extra build -o requirements.lock pyproject.toml
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-header --python-version 3.11 \
		--extra build --extra test -o requirements-test.lock pyproject.toml
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-header --python-version 3.11 \
		--extra build --extra viz -c requirements.lock -o requirements-viz.lock pyproject.toml

clean:
	rm -rf .venv runs
