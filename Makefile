# make demo | test | check | train-test | bench | clean. The first call sets up .venv (setup.sh); nothing else is installed by hand.
PYTHON ?=
BIN := .venv/bin
JOBS ?= 2

.PHONY: setup demo test lint wheel check train-test bench clean

setup: .venv/.ready

.venv/.ready: pyproject.toml setup.sh
	PYTHON="$(PYTHON)" ./setup.sh

demo: .venv/.ready
	$(BIN)/tubepose bench --out out/demo

test: .venv/.ready
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

lint: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The wheel as a user gets it: built, installed into a clean environment, run from outside the source tree.
wheel: .venv/.ready
	rm -rf out/wheel
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir out/wheel .
	$(BIN)/python -m venv out/wheel/venv
	out/wheel/venv/bin/python -m pip install --quiet out/wheel/tubepose-*.whl
	cd out/wheel && venv/bin/tubepose --help >/dev/null
	cd out/wheel && venv/bin/tubepose labware list
	cd out/wheel && venv/bin/tubepose bench --methods upright --out bench

check: lint test wheel

# What needs the extra `train` (PyTorch, some GB), in an environment of its own: a few minutes.
train-test: .venv-train/.ready
	.venv-train/bin/python -m pytest tests/test_training_loop.py

.venv-train/.ready: .venv/.ready
	[ -x .venv-train/bin/python ] || $(BIN)/python -m venv .venv-train
	.venv-train/bin/python -m pip install --quiet --upgrade --editable ".[dev,train]"
	touch .venv-train/.ready

# The tables of benchmarks/README.md; BENCH_ARGS names sessions and options.
bench: .venv/.ready
	$(BIN)/tubepose bench --out out/bench $(BENCH_ARGS)

clean:
	rm -rf out build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
