# make demo   set up .venv if needed, run the embedded demo, say where the pictures are
# make test   set up .venv if needed, run the tests
# make lock   resolve requirements.lock anew from setup.cfg (needs uv)
# make clean  remove .venv and runs
# Python 3.10 to 3.12; another one than python3: make demo PYTHON=python3.12

PYTHON ?= python3
VENV ?= .venv
RUN := $(VENV)/bin/python

.PHONY: demo test setup lock clean
demo: setup
	$(RUN) run.py scenes/demo.yaml

test: setup
	$(RUN) -m pytest -q -rs

setup: $(VENV)/ready
	@sh tools/system-libraries $(RUN)

# Reinstalled only when the requirements change.
$(VENV)/ready: requirements.lock setup.cfg setup.py pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v <= (3, 12) else "Python 3.10 to 3.12 is needed, $(PYTHON) is %d.%d: make PYTHON=python3.12" % v)'
	@$(PYTHON) -m venv $(VENV) || { echo "the venv module is missing; on Debian and Ubuntu: sudo apt-get install python3-venv"; exit 1; }
	$(RUN) -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(RUN) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

lock:
	uv pip compile --universal --python-version 3.10 --extra test --no-header --no-annotate --constraint tools/lock-constraints.txt setup.cfg --output-file requirements.lock

clean:
	rm -rf $(VENV) runs
