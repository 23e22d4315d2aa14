# make render [SCENE=3] [ARGS="aa=2"]   render a scene to out/sceneN.png and .exr
# make test   [ARGS="-k llvm"]          run the tests
# make fuzz                            random inputs, ten thousand for each reader: a few minutes
# make attack [ROUNDS=10]               hostile files, signals, threads, limits: some minutes; 100 rounds: an hour
# make docs                            the documentation as a site: docs/_build/index.html
# make pictures [ARGS="check"]          the pictures of README anew, in docs/pictures
# make browser                         site, reports and pages of checks as an installed Chromium shows them
# make bench  [ARGS="--before PYTHON"]  time renders, interleaved with an earlier version
# make device-check                    pictures and tests on an NVIDIA GPU, in five minutes at most
# make bench-gpu                       times on an NVIDIA GPU
# make setup                            the environment alone: .venv with the commands mrt and mrt-validate
# make develop                          the same with all that tests, documentation and style need
# make format                          lay out all Python files, and sort their imports
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
# Said before steps of more than ten seconds, on two cores
say = @echo "$(1)"
install = @echo "Installing [$(EXTRAS)]: a minute or two" && \
	$(BIN)/python -m pip install --quiet --editable '.[$(EXTRAS)]'

.PHONY: setup develop render test device-check fuzz attack bench bench-gpu docs pictures browser format lint types package clean
setup: $(STAMP)-base

develop: $(STAMP)-all

render: $(STAMP)-base
	@mkdir -p $(OUT)
	@$(BIN)/mrt $(OUT)/scene$(SCENE) $(SCENE) $(ARGS)
	@echo "The picture is in $(OUT)/"

test: $(STAMP)-test
	$(call say,Running the tests: some ten minutes)
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder $(ARGS)

fuzz: $(STAMP)-test
	$(call say,Trying random inputs: a few minutes)
	$(BIN)/python -m pytest -m fuzz --hypothesis-profile=long --hypothesis-show-statistics $(ARGS)

attack: $(STAMP)-test
	$(call say,Trying hostile files and signals: some minutes)
	MRT_ATTACK_ROUNDS=$(ROUNDS) $(BIN)/python -m pytest -m "attack or fuzz" $(ARGS)

bench: $(STAMP)-test
	$(call say,Timing renders: some minutes)
	$(BIN)/python -m mrt_mitsuba.validation.bench --out $(OUT)/bench.json $(ARGS)

DEVICE ?= cuda
device-check: $(STAMP)-test
	$(call say,Checking a GPU: at most five minutes)
	$(BIN)/python -m mrt_mitsuba.validation.device $(ARGS)

bench-gpu: $(STAMP)-test
	$(call say,Timing renders on a GPU: some minutes)
	@mkdir -p $(OUT)
	$(BIN)/python -m mrt_mitsuba.validation.bench --variant $(DEVICE)_ad_rgb --out $(OUT)/bench-gpu.json $(ARGS)

format: $(STAMP)-dev
	$(BIN)/ruff check --fix --select I .
	$(BIN)/ruff format .

lint: $(STAMP)-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Types are checked on a copy laid out as installed: mypy does not follow the mapping of folders to one name.
types: $(STAMP)-dev
	$(call say,Checking types: half a minute)
	@rm -rf build/types && mkdir -p build/types && cp -r mrt_mitsuba build/types
	@cp -r plugins scenes_xml validation build/types/mrt_mitsuba
	cd build/types && $(abspath $(BIN))/mypy --config-file $(CURDIR)/pyproject.toml -p mrt_mitsuba

# The site, with its pictures and numbers made on the way: docs/_build/index.html
docs: $(STAMP)-docs
	$(call say,Building the site and running its code: some six minutes)
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build

pictures: $(STAMP)-browser
	$(call say,Making the pictures: some minutes)
	$(BIN)/python docs/pictures/make.py $(ARGS)

# The site as make docs left it; if it has not, one without what the pages' code shows
browser: $(STAMP)-browser
	$(call say,Opening pages in a browser: some minutes)
	$(BIN)/python -m pytest -m browser $(ARGS) tests/system/test_browser.py tests/system/test_pictures.py

# Both are tried, in an environment of their own, before they are left in dist/
package: $(STAMP)-dev $(STAMP)-test
	$(call say,Building and installing wheel and sdist: a few minutes)
	$(BIN)/python -m pytest -m package
	rm -rf build/lib dist
	$(BIN)/python -m build

clean:
	rm -rf $(VENV) build dist *.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "mrt-mitsuba needs Python 3.10 or newer: make PYTHON=python3.11 ..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
		{ echo "no venv module: on Debian and Ubuntu, apt install python3-venv"; rm -rf $(VENV); exit 1; }

$(STAMP)-base: pyproject.toml | $(BIN)/python
	@echo "Installing: a minute or two"
	@$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(STAMP)-test: EXTRAS := test,validation
$(STAMP)-test: pyproject.toml | $(BIN)/python
	$(install)
	@touch $@ $(STAMP)-base

$(STAMP)-docs: EXTRAS := docs,validation
$(STAMP)-docs: pyproject.toml | $(BIN)/python
	$(install)
	@touch $@ $(STAMP)-base

$(STAMP)-browser: EXTRAS := test,docs,validation,browser
$(STAMP)-browser: pyproject.toml | $(BIN)/python
	$(install)
	@touch $@ $(STAMP)-base

$(STAMP)-dev: EXTRAS := dev
$(STAMP)-dev: pyproject.toml | $(BIN)/python
	$(install)
	@touch $@ $(STAMP)-base

$(STAMP)-all: EXTRAS := test,docs,validation,browser,dev
$(STAMP)-all: pyproject.toml | $(BIN)/python
	$(install)
	@touch $@ $(STAMP)-base $(STAMP)-test $(STAMP)-docs $(STAMP)-browser $(STAMP)-dev
