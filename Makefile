# make demo   set up .venv if needed, run the embedded demo, say where the pictures are
# make test   set up .venv if needed, run the tests; another set of random inputs: make test TEST_SEED=7
# make quick  the tests without those marked slow: for the inner loop
# make lock   resolve requirements.lock anew from setup.cfg (needs uv)
# make clean  remove .venv and runs
# Python 3.10 to 3.12; another one than python3: make demo PYTHON=python3.12

PYTHON ?= python3
VENV ?= .venv
RUN := $(VENV)/bin/python
WORKERS ?= 2
TEST_SEED ?= 0
export TEST_SEED
# A file of tests stays in one process, for its fixtures and kernels; in the files' order, of which the last are short.
TESTS := $(RUN) -m pytest -q -rs -n $(WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test quick setup lock clean
demo: setup
	$(RUN) run.py scenes/demo.yaml

test: setup
	$(TESTS)

quick: setup
	$(TESTS) -m "not slow"

setup: $(VENV)/ready
	@sh tools/system-libraries $(RUN)

# Reinstalled only when the requirements change.
$(VENV)/ready: requirements.lock setup.cfg pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v <= (3, 12) else "Python 3.10 to 3.12 is needed, $(PYTHON) is %d.%d: make PYTHON=python3.12" % v)'
	@$(PYTHON) -m venv $(VENV) || { echo "the venv module is missing; on Debian and Ubuntu: sudo apt-get install python3-venv"; exit 1; }
	$(RUN) -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(RUN) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

lock:
	uv pip compile --universal --python-version 3.10 --extra test --no-header --no-annotate --constraint tools/lock-constraints.txt setup.cfg --output-file requirements.lock

clean:
	rm -rf $(VENV) runs
