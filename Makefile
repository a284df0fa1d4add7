# `make demo` and `make test` work on a fresh machine with python3 >= 3.11, venv and make.
PYTHON ?= python3
BIN := .venv/bin
DEMO := build/demo
SCENE ?= room
SEED ?= 0

.PHONY: install demo demo-clean test bench lint clean sample redkitchen

install: .venv/installed

.venv/installed: constraints.txt pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

# Every step starts from what the step before wrote; nothing is prepared. A second `make demo` starts over.
demo: install
	rm -rf $(DEMO)
	$(BIN)/sim-bridge synthesize --scene $(SCENE) --seed $(SEED) --format mcap --out $(DEMO)/session
	$(BIN)/fieldkit map build $(DEMO)/session/mapping --out $(DEMO)/lab.map
	$(BIN)/fieldkit tags calibrate $(DEMO)/session/photos --map $(DEMO)/lab.map --size-m 0.1365 --out $(DEMO)/tags.toml
	$(BIN)/fieldkit replay $(DEMO)/session --map $(DEMO)/lab.map --tags $(DEMO)/tags.toml --protocol paper_real --out $(DEMO)/run
	$(BIN)/fieldkit report $(DEMO)/run --out $(DEMO)/report.html
	$(BIN)/fieldkit judge $(DEMO)/session --map $(DEMO)/lab.map --tags $(DEMO)/tags.toml --run $(DEMO)/run
	$(BIN)/fieldkit score $(DEMO)/run

test: install
	$(BIN)/python -m pytest

bench: install
	$(BIN)/python -m pytest tests/bench --benchmark-enable --benchmark-only

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf build .venv
