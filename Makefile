# Each target sets itself up: a virtual environment in .venv, made on first use.
PYTHON ?= python3
PIP := .venv/bin/pip --disable-pip-version-check

# Tests of single parts: no commands, descents, bags, property tests of whole rows, nor comparisons over many robots.
FAST := tests/config tests/logs tests/robot tests/regressor tests/sensing tests/problem/test_rows_two_ways.py \
	tests/estimators/test_conditions.py tests/estimators/test_least_squares.py tests/estimators/test_penalties.py
SLOW := tests/logs/test_bags.py tests/logs/test_bag_messages.py tests/logs/test_bag_stamps.py tests/logs/test_mutations.py \
	tests/regressor/test_oracle.py tests/robot/test_shapes.py
SIM := tests/simulation tests/robot tests/report tests/commands/test_mjcf_runs.py tests/commands/test_replay.py \
	tests/commands/test_closed_loops.py
TESTS ?= tests

.PHONY: demo test test-oldest-mujoco test-fast coverage site clean

demo: .venv/ready
	.venv/bin/torchid demo overwrite=true

# One worker by core, each with one thread: with as many threads as cores in each, they wait for one another.
test test-oldest-mujoco test-fast coverage: export OMP_NUM_THREADS = 1
# Many tests run commands in processes of their own, which import what was compiled once.
test test-oldest-mujoco test-fast coverage: export PYTHONDONTWRITEBYTECODE =

test: .venv/ready-for-tests
	.venv/bin/ruff check setup.py torchid scripts tests
	.venv/bin/ruff format --check setup.py torchid scripts tests
	.venv/bin/mypy
	.venv/bin/lint-imports
	.venv/bin/pytest -n auto --dist loadfile

# What simulates, with the oldest MuJoCo that the extra [sim] takes, in place of the newest.
test-oldest-mujoco: .venv/ready-for-tests
	$(PIP) install -q --no-deps --upgrade --target .venv/oldest-mujoco mujoco==3.3.7
	PYTHONPATH=$(CURDIR)/.venv/oldest-mujoco .venv/bin/pytest -n auto --dist loadfile $(SIM)

test-fast: .venv/ready-for-tests
	.venv/bin/pytest -n auto --dist loadfile $(FAST) $(SLOW:%=--deselect=%)

coverage: .venv/ready-for-tests
	.venv/bin/pytest -n auto --dist loadfile --cov=torchid $(TESTS)

site: .venv/ready-for-tests
	.venv/bin/mkdocs build

clean:
	rm -rf .venv .coverage

.venv/ready: pyproject.toml constraints.txt setup.py $(wildcard torchid/kernels/*.cpp torchid/kernels/*.h)
	$(PYTHON) -m venv .venv
	$(PIP) install -q --no-compile -c constraints.txt torch  # Python compiles what is imported of it
	$(PIP) install -q -c constraints.txt -e '.[tables]'
	touch $@

.venv/ready-for-tests: .venv/ready
	$(PIP) install -q -c constraints.txt -e '.[dev]'
	touch $@
