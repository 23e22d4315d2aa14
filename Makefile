# make render [SCENE=3] [ARGS="aa=2"]   render a scene to out/sceneN.png and .exr
# make test   [ARGS="-k llvm"]          run the tests
# make fuzz                            random inputs, ten thousand for each reader: a few minutes
# make attack [ROUNDS=10]               hostile files, signals, threads, limits: some minutes; 100 rounds: an hour
# make docs                            the documentation as a site: docs/_build/index.html
# make pictures [ARGS="check"]          the pictures of README anew, in docs/pictures
# make browser                         site, reports and pages of checks as an installed Chromium shows them
# make bench  [ARGS="--before PYTHON"]  time renders, in turns with an earlier version
# make device-check                    pictures and tests on an NVIDIA GPU, in five minutes at most
# make bench-gpu                       times on an NVIDIA GPU
# make setup                            the environment alone: .venv with the commands mrt and mrt-validate
# make develop                          the same with all that tests, documentation and style need
# make lint, make types, make package   style, types, wheel and sdist
PYTHON ?= python3
VENV   ?= .venv
SCENE  ?= 3
ARGS   ?=
OUT    ?= out
ROUNDS ?= 10

BIN  := $(VENV)/bin
# One stamp per set of extras: installing one leaves the others as they are.
STAMP := $(VENV)/.mrt

.PHONY: setup develop render test device-check fuzz attack bench bench-gpu docs pictures browser lint types package clean
setup: $(STAMP)-base

develop: $(STAMP)-all

render: $(STAMP)-base
	@mkdir -p $(OUT)
	@$(BIN)/mrt $(OUT)/scene$(SCENE) $(SCENE) $(ARGS)
	@echo "The picture is in $(OUT)/"

test: $(STAMP)-test
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder $(ARGS)

fuzz: $(STAMP)-test
	$(BIN)/python -m pytest -m fuzz --hypothesis-profile=long --hypothesis-show-statistics $(ARGS)

attack: $(STAMP)-test
	MRT_ATTACK_ROUNDS=$(ROUNDS) $(BIN)/python -m pytest -m "attack or fuzz" $(ARGS)

bench: $(STAMP)-test
	$(BIN)/python -m mrt_mitsuba.validation.bench --out $(OUT)/bench.json $(ARGS)

DEVICE ?= cuda
device-check: $(STAMP)-test
	$(BIN)/python -m mrt_mitsuba.validation.device $(ARGS)

bench-gpu: $(STAMP)-test
	@mkdir -p $(OUT)
	$(BIN)/python -m mrt_mitsuba.validation.bench --variant $(DEVICE)_ad_rgb --out $(OUT)/bench-gpu.json $(ARGS)

lint: $(STAMP)-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Types are checked on a copy laid out as installed: mypy does not follow the mapping of folders to one name.
types: $(STAMP)-dev
	@rm -rf build/types && mkdir -p build/types && cp -r mrt_mitsuba build/types
	@cp -r plugins scenes_xml validation build/types/mrt_mitsuba
	cd build/types && $(abspath $(BIN))/mypy --config-file $(CURDIR)/pyproject.toml -p mrt_mitsuba

# The site, with its pictures and numbers made on the way: docs/_build/index.html
docs: $(STAMP)-docs
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build

pictures: $(STAMP)-browser
	$(BIN)/python docs/pictures/make.py $(ARGS)

# The site as make docs left it; if it has not, one without what the pages' code shows
browser: $(STAMP)-browser
	$(BIN)/python -m pytest -m browser $(ARGS) tests/system/test_browser.py tests/system/test_pictures.py

# Both are tried, in an environment of their own, before they are left in dist/
package: $(STAMP)-dev $(STAMP)-test
	$(BIN)/python -m pytest -m package
	rm -rf build/lib dist
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) build dist *.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "mrt-mitsuba needs Python 3.10 or newer: make PYTHON=python3.11 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV) || \
		{ echo "no venv module: on Debian and Ubuntu, apt install python3-venv"; rm -rf $(VENV); exit 1; }

$(STAMP)-base: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(STAMP)-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[test,validation]'
	@touch $@ $(STAMP)-base

$(STAMP)-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[docs,validation]'
	@touch $@ $(STAMP)-base

$(STAMP)-browser: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[test,docs,validation,browser]'
	@touch $@ $(STAMP)-base

$(STAMP)-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@ $(STAMP)-base

$(STAMP)-all: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[test,docs,validation,browser,dev]'
	@touch $@ $(STAMP)-base $(STAMP)-test $(STAMP)-docs $(STAMP)-browser $(STAMP)-dev
