# `make demo` and `make test` need only Python >= 3.11 and make.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
JOBS   ?= 2
NEWER  ?= python3.13
# The versions that the suite has passed with; `make CONSTRAINTS= test` takes the newest there are.
CONSTRAINTS ?= constraints.txt
INSTALL := -m pip install -q --disable-pip-version-check $(if $(CONSTRAINTS),-c $(CONSTRAINTS))
# Of the slow tests and the documented commands an eighth; which one, the day of the last
# commit says, so that a commit is judged by the same tests whenever that happens. All: PART=0/1.
PART   ?= $(shell expr $$(git log -1 --format=%ct 2>/dev/null || date +%s) / 86400 % 8)/8

# Compiled programs are kept between runs, the small ones too: compiling is most of the time of a
# short run, and half of it is programs of one operation.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.cache/jax
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0

.PHONY: help demo report detector test slow mutate commands lint types docs wheel lowest newer check clean
.DEFAULT_GOAL := help

help:  ## list the commands
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

$(VENV)/.run: pyproject.toml constraints.txt
	@echo "== installing what a run needs into $(VENV)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python $(INSTALL) -e .
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt
	@echo "== installing what tests, lint and docs need into $(VENV)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python $(INSTALL) -e '.[dev]'
	@touch $@ $(VENV)/.run

demo: $(VENV)/.run  ## install what a run needs and show the main job, with pictures (<= 6 min)
	@echo "== running the demo; pictures and numbers go to runs/demo"
	$(BIN)/python scripts/demo.py

report: $(VENV)/.run  ## run a small piece of each chapter and write report/index.html
	$(BIN)/python scripts/studies/reproduce.py --preset quick

# No weights are part of this repository; this makes some. What is there is not made again.
DETECTOR := $(BIN)/python scripts/train_detector.py
FRAMES   := --data runs/detector_frames --size small
NETWORK  := $(FRAMES) --model dense_argate --failures
detector: $(VENV)/.run  ## simulate frames, train a small detector on them, write it as a program (< 30 CPU-min)
	@$(BIN)/python $(INSTALL) -e '.[export]'
	$(BIN)/python scripts/simulate_kitti.py --frames 2400 --val 100 --test 100 --size small --resume \
	  --out runs/detector_frames
	test -f runs/detector_frames/cache_small/cache.json || $(DETECTOR) prepare $(FRAMES) --any-size
	$(DETECTOR) train $(NETWORK) --steps 3000 --resume
	$(DETECTOR) eval $(NETWORK) --pictures 2
	$(DETECTOR) export $(NETWORK) --out runs/detector.stablehlo

test: $(VENV)/.dev  ## install what the tests need and run the default suite (<= 15 min on two cores)
	@echo "== running the default test suite on $(JOBS) workers"
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

# The peer that the spiking networks are compared with; where it cannot be had, its test says so.
.cache/brian2/bin/python:
	@echo "== installing Brian 2 into .cache/brian2"
	@$(PYTHON) -m venv .cache/brian2 && { .cache/brian2/bin/pip install -q --disable-pip-version-check \
	  'numpy<2.3' 'brian2>=2.9' || echo "Brian 2 could not be installed"; }

slow: $(VENV)/.dev .cache/brian2/bin/python  ## an eighth of the long tests, another every day
	BRIAN2_PYTHON=$(CURDIR)/.cache/brian2/bin/python \
	  $(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m slow --slow-part $(PART)

mutate: $(VENV)/.dev  ## break the code in some seventy places, one at a time: tests must notice
	$(BIN)/python scripts/tools/mutate.py

commands: $(VENV)/.dev  ## run the commands of README and docs (an eighth, another every day) at their smallest size
	$(BIN)/python scripts/tools/check_commands.py --jobs $(JOBS) --part $(PART)

lint: $(VENV)/.dev  ## ruff: style and errors
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev  ## mypy over the packages and the scripts
	$(BIN)/mypy

docs: $(VENV)/.dev  ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

wheel: $(VENV)/.dev  ## build the wheel and import it from outside the repository
	$(BIN)/python scripts/tools/check_wheel.py

lowest: $(VENV)/.dev  ## a few test files with the lowest allowed versions, in an environment of their own
	$(BIN)/python scripts/tools/check_lowest.py

newer: $(VENV)/.dev  ## the same test files with a newer Python, in an environment of their own
	$(BIN)/python scripts/tools/check_lowest.py --python $(NEWER) --versions constraints

check: lint types docs wheel test slow commands lowest  ## everything that CI runs

clean:  ## remove what the other commands made, but not runs/ or results/
	rm -rf $(VENV) .cache site build dist .pytest_cache .mypy_cache .ruff_cache
