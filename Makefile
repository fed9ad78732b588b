# demo   a real log to a picture       test      quick proofs      test-all  and the long ones
# lint   style and types               bench     measurements      docs      generated pages      clean
EXTRAS ?= dev

# The newest Python that gtsam has wheels for and that can make a venv; a name on the PATH alone proves neither.
CHECK  := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 14))
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
            $$p -c '$(CHECK)' 2>/dev/null && { echo $$p; break; }; done)
BIN    := .venv/bin
BAG    := demo/victoria_park.mcap
RUN    := demo/run

.PHONY: demo venv test test-all lint bench docs clean
.DELETE_ON_ERROR:

demo: .venv/.stamp-base
	@rm -rf $(RUN) $(BAG)
	@mkdir -p demo
	$(BIN)/slam-backend dataset victoria_park --out $(BAG)
	$(BIN)/slam-backend replay $(BAG) --config config/victoria_park.yaml --out $(RUN)
	@echo "open $$(ls $(RUN)/*.png): odometry alone, and the smoothed path with its landmarks"

venv: .venv/.stamp-$(EXTRAS)

test: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m pytest -m "not slow"

test-all: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m pytest

lint: .venv/.stamp-$(EXTRAS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m bench

docs: .venv/.stamp-$(EXTRAS)
	$(BIN)/python -m slam_backend.lab.settings > docs/settings.md

clean:
	rm -rf .venv demo build install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

# One stamp per set of extras: `base` has none, `dev,ros` has two.
.venv/.stamp-%: setup.py constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11, 3.12 or 3.13 that can make a venv; say which: make PYTHON=..." >&2; exit 1; }
	@$(BIN)/python -c 'import pip' 2>/dev/null || $(PYTHON) -m venv --clear .venv
	@echo "installing into .venv with $$($(BIN)/python --version)"
	@$(BIN)/python -m pip install -c constraints.txt -e '.$(if $(filter base,$*),,[$*])' >.venv/pip.log 2>&1 || \
	  { echo "make: cannot install: $$(grep -m 1 -o 'ERROR.*' .venv/pip.log || tail -n 1 .venv/pip.log) (all of it: .venv/pip.log)" >&2; exit 1; }
	@touch $@
