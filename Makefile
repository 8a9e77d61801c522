PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-slow check docs results release lock clean

demo: .venv/installed
	$(BIN)/distrace demo --out out/demo

test: .venv/installed  ## each file in one process: what its tests share is made once
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

test-slow: .venv/installed  ## those that take seven seconds or more
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow

check: .venv/installed  ## style and types
	$(BIN)/ruff check src experiments tests examples docs/site
	$(BIN)/ruff format --check src experiments tests examples docs/site
	$(BIN)/pyright

docs: .venv/installed  ## the documentation, which opens as out/docs/index.html
	NO_MKDOCS_2_WARNING=1 PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m mkdocs build --strict

results: .venv/installed  ## the tables that take under a minute
	$(BIN)/python -m experiments fields sofas --size 64 --out out/fields
	$(BIN)/distrace check-gradients sofas --out out/gradient-check

release: .venv/installed check test test-slow
	$(BIN)/python -m pip install --quiet build twine
	$(BIN)/python -m build
	$(BIN)/python -m twine check dist/*

# The environment; made again only when what it is made from changes.
.venv/installed: requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# torch pins the CUDA libraries it brings where it can use them; the lock leaves them to it.
lock:
	echo torch==2.13.0 > .torch-pin
	$(BIN)/python -m uv pip compile pyproject.toml --extra dev --universal --python-version 3.10 --quiet --no-annotate --no-header \
	    --constraint .torch-pin | grep -vE '^(nvidia|cuda|triton)' > requirements.lock
	rm .torch-pin

clean:
	rm -rf .venv out
