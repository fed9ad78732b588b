# demo   a real log to a picture       test      quick proofs      test-all  and the long ones
# lint   style and types               bench     measurements      docs      generated pages      clean
# figures   those of the README and of docs/sensors.md, from real data
# tf     tf2_msgs, which the ROS wheels lack

# The tests speak over real DDS: with the ROS wheels, which exist for x86-64 Linux, unless a ROS install has been sourced.
comma  := ,
WHEELS := $(if $(ROS_DISTRO),,$(filter Linux-x86_64,$(shell uname -s)-$(shell uname -m)))
EXTRAS ?= dev$(comma)eval$(if $(WHEELS),$(comma)ros)

# The newest Python that gtsam has wheels for and that can make a venv; a name on the PATH alone proves neither.
CHECK  := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 14))
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
            $$p -c '$(CHECK)' 2>/dev/null && { echo $$p; break; }; done)
BIN    := .venv/bin
BAG    := demo/victoria_park.mcap
RUN    := demo/run

.PHONY: demo figures venv tf test test-all lint bench docs clean
.DELETE_ON_ERROR:

demo: .venv/.stamp-base
	@rm -rf $(RUN) $(BAG)
	@mkdir -p demo
	$(BIN)/slam-backend dataset victoria_park --out $(BAG)
	$(BIN)/slam-backend replay $(BAG) --config config/victoria_park.yaml --out $(RUN)
	@echo "open $$(ls $(RUN)/*.png): odometry alone, and the smoothed path with its landmarks"

figures: demo
	cp $(RUN)/trajectory.png docs/victoria_park.png
	$(BIN)/python -m bench.figures

venv: .venv/.stamp-$(EXTRAS)

tf: .venv/.stamp-$(EXTRAS)
	@$(BIN)/python -m slam_backend.ros.tf2

test: tf
	$(BIN)/python -m pytest -m "not slow"

test-all: tf
	$(BIN)/python -m pytest

lint: .venv/.stamp-$(EXTRAS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m bench

docs: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m slam_backend.lab.settings > docs/settings.md
	$(BIN)/python -m slam_backend.lab.firewall > docs/firewall.md

clean:
	rm -rf .venv demo build install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

# One stamp per set of extras: `base` has none, `dev,eval` has two. Where the ROS wheels cannot be installed, the rest is.
.venv/.stamp-%: WANTED = $(patsubst %,'.[%]',$* $(filter-out $*,$(subst $(comma)ros,,$*)))
.venv/.stamp-%: setup.py constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11, 3.12 or 3.13 that can make a venv; say which: make PYTHON=..." >&2; exit 1; }
	@$(BIN)/python -c 'import pip' 2>/dev/null || $(PYTHON) -m venv --clear .venv
	@echo "installing into .venv with $$($(BIN)/python --version)"
	@for wanted in $(subst [base],,$(WANTED)); do \
	  $(BIN)/python -m pip install -c constraints.txt -e "$$wanted" >.venv/pip.log 2>&1 && { touch $@; exit 0; }; \
	  echo "make: cannot install $$wanted: $$(grep -m 1 -o 'ERROR.*' .venv/pip.log || tail -n 1 .venv/pip.log) (all of it: .venv/pip.log)" >&2; \
	done; exit 1
