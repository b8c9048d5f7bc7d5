# Each target sets itself up: a virtual environment in .venv, made on first use.
PYTHON ?= python3
PIP := .venv/bin/pip --disable-pip-version-check

.PHONY: demo test clean

demo: .venv/ready
	.venv/bin/torchid identify torchid/demo/quadruped.yaml output=runs/quadruped overwrite=true

test: .venv/ready-for-tests
	.venv/bin/ruff check torchid scripts tests
	.venv/bin/ruff format --check torchid scripts tests
	.venv/bin/mypy
	.venv/bin/lint-imports
	.venv/bin/pytest -n auto --dist loadfile

clean:
	rm -rf .venv

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) install -q -c constraints.txt torch
	$(PIP) install -q -c constraints.txt -e .
	touch $@

.venv/ready-for-tests: .venv/ready
	$(PIP) install -q -c constraints.txt -e '.[dev]'
	touch $@
