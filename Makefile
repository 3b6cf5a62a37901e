# Everything runs from .venv, which `setup` makes and keeps up to date.
#   make setup PYTHON=python3.12   choose the Python; said once, it is kept
#   make demo RATE=5               run the demo at five times real time
.DEFAULT_GOAL := help
PYTHON ?=
RATE ?=
BIN := .venv/bin

# Tests that start processes or measure them have the machine to themselves; of the others as many run
# at a time as there are processors, those of a file in one process. What waits for processes gets a
# second try: a machine may be busy with something else.
ALONE := tests/nodes tests/lab/bench tests/docs tests/lab/report tests/cli/test_demo.py \
  tests/offline/test_replay.py tests/cli/test_watch.py
TOGETHER := -n auto --dist loadfile
# What runs again with the oldest versions: all that computes with NumPy, SciPy and Numba, what takes
# arrays from messages, and from end to end a recorded run, a study and a picture.
OLDEST := tests/core tests/bag tests/lab/study/test_study_run.py tests/lab/figures/test_run_figure.py \
  tests/test_project.py::test_reference_run_gives_its_states_again

.PHONY: help setup docs browser demo test test-newest test-oldest lint colcon clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1	\2/' | expand -t 16

setup: ## make .venv: ROS 2 Jazzy (sourced, or from wheels), messages, this package
	@python3 tools/setup_env.py $(if $(PYTHON),--python $(PYTHON))

demo: setup ## run the demo (RATE: times real time)
	@$(BIN)/dopslam demo $(if $(RATE),--rate $(RATE))

test: test-newest test-oldest ## run the tests, with the newest and the oldest numpy and scipy

test-newest: setup browser ## run the tests in .venv
	@$(BIN)/python -m pytest $(TOGETHER) $(addprefix --ignore=,$(ALONE))
	@$(BIN)/python -m pytest $(ALONE) --reruns 1

# Numba drops machine code of another version of itself: in one folder the two would do so in turns.
test-oldest: export NUMBA_CACHE_DIR := $(CURDIR)/.venv-oldest/kernels
test-oldest: ## run those tests again that depend on numpy, scipy and numba, in .venv-oldest
	@python3 tools/setup_env.py --oldest $(if $(PYTHON),--python $(PYTHON))
	@.venv-oldest/bin/python -m pytest $(TOGETHER) $(OLDEST)

browser: ## install Chromium for the tests of pages, where root has apt-get
	@python3 tools/browser.py

lint: setup ## check style and types
	@$(BIN)/python -m ruff check .
	@$(BIN)/python -m mypy

docs: setup ## draw the figures and build docs/_build/html; warnings are errors
	@$(BIN)/python docs/draw.py docs/figures
	@$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

colcon: setup ## build both packages into install/ with colcon
	@. .venv/ros_env.sh && { command -v colcon >/dev/null || \
	  { echo "colcon is missing: sudo apt install python3-colcon-common-extensions" >&2; exit 1; }; } \
	  && colcon build

clean: ## remove .venv, what colcon built, and the caches
	rm -rf .venv .venv-oldest build install log *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find dopslam_ros tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
