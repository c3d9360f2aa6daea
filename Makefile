# `make` or `make help` lists the targets: what stands behind ## after them.

PYTHON ?= python3
VENV ?= .venv
RUN := $(VENV)/bin/python
WORKERS ?= 2
TEST_SEED ?= 0
export TEST_SEED
# A file of tests stays in one process, for its fixtures and kernels; in the files' order, of which the last are short.
TESTS := $(RUN) -m pytest -q -rs -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(PYTEST_OPTIONS)

.PHONY: help demo quick test lint setup lock clean
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "Python 3.10 to 3.12; another one than $(PYTHON): make demo PYTHON=python3.12"

demo: setup ## run the embedded demo scene, no download; results in runs/demo/
	$(RUN) run.py scenes/demo.yaml

quick: setup ## run the tests without those marked slow: for the inner loop
	$(TESTS) -m "not slow"

test: setup ## run all tests; with other random inputs: make test TEST_SEED=7
	$(TESTS)

lint: setup ## format, lint, types
	$(RUN) -m ruff format --check --quiet .
	$(RUN) -m ruff check --quiet .
	$(RUN) -m mypy

setup: $(VENV)/ready ## install what is needed into .venv (the other targets do so by themselves)
	@sh tools/system-libraries $(RUN)

# Reinstalled only when the requirements change.
$(VENV)/ready: requirements.lock setup.cfg setup.py pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v <= (3, 12) else "Python 3.10 to 3.12 is needed, $(PYTHON) is %d.%d: make PYTHON=python3.12" % v)'
	@$(PYTHON) -m venv $(VENV) || { echo "the venv module is missing; on Debian and Ubuntu: sudo apt-get install python3-venv"; exit 1; }
	$(RUN) -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(RUN) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

lock: ## resolve requirements.lock anew from setup.cfg (needs uv)
	UV_CUSTOM_COMPILE_COMMAND="make lock" uv pip compile --universal --python-version 3.10 --extra test --extra lint --no-annotate --constraint tools/lock-constraints.txt setup.cfg --output-file requirements.lock

clean: ## remove .venv and runs
	rm -rf $(VENV) runs
