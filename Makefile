# Everything a user or a developer does with a clone; `make help` lists it.
#
# A fresh Debian 12 or 13 with its Python needs nothing else: the environment in .venv is made from the locked
# requirements (hashes checked) and made again when a lock file changes. Debian packages are installed only
# where that is allowed (root, or sudo without a password); otherwise the missing ones are named.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
MAKEFLAGS += --no-builtin-rules --no-print-directory
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --quiet
# More than two cores have: half of what the tests do is to wait for programs and ports.
JOBS := 3
# A Python 3.11 or newer; `make PYTHON=/path/to/python3.12 test` chooses another.
PYTHON ?=

# $(call step,what,command): one line; the command's output is shown only when it fails.
step = @printf '  %-34s' '$(1)'; log=$$(mktemp); trap 'rm -f "$$log"' EXIT; \
	if ( $(2) ) >"$$log" 2>&1; then echo ok; else echo FAILED; cat "$$log"; exit 1; fi

.PHONY: help
help: ## Show this list.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.PHONY: demo
demo: $(VENV)/.runtime ## Run simulated controllers, the gateway and its three faces; Ctrl-C stops.
	@tests/peers/install.sh mbpoll snmp curl || echo 'Going on: the demo runs, but some of the commands it prints are missing.'
	@exec $(BIN)/python -m gateway demo

.PHONY: test
test: setup lint ## Set everything up, lint, and run the tests.
	@$(BIN)/python -m pytest -m 'not long' -n $(JOBS) --dist=worksteal

.PHONY: test-long
test-long: setup ## Run the long tiers: whole days, chaos, churn, restarts, installation; SOAK_S=3600 makes chaos an hour.
	@$(BIN)/python -m pytest -m long -n 2 --timeout=3600

.PHONY: test-newest
test-newest: setup ## Run what depends on libraries with the newest versions that pyproject.toml allows.
	@echo 'Making $(VENV)-newest:'
	@rm -rf $(VENV)-newest; $(BIN)/python -m venv $(VENV)-newest
	$(call step,newest versions,$(VENV)-newest/bin/python -m pip --disable-pip-version-check --quiet --quiet install --editable '.[fast$(COMMA)dev]')
	@$(VENV)-newest/bin/python -m tests.supply.versions requirements-dev.txt
	@$(VENV)-newest/bin/python -m pytest -m 'not long' -n $(JOBS) $(LIBRARY_TESTS)

COMMA := ,
# The rooms where behaviour of pymodbus, pysnmp, pyserial and prometheus-client shows.
LIBRARY_TESTS := tests/characterisation tests/conformance tests/modbus tests/lines tests/faces

.PHONY: coverage
coverage: setup ## Run the tests of `make test` with branch coverage, and show which lines they do not reach.
	@$(BIN)/python -m pytest -m 'not long' -n $(JOBS) --dist=worksteal --cov --cov-report=term

.PHONY: lint
lint: $(VENV)/.dev ## Check style, types, the layers, and that derived files are current.
	$(call step,style (ruff check),$(BIN)/ruff check .)
	$(call step,format (ruff format),$(BIN)/ruff format --check --diff .)
	$(call step,types (mypy),$(BIN)/mypy)
	$(call step,layers (import-linter),$(BIN)/lint-imports)
	$(call step,derived files (generate --check),$(BIN)/prostar-gateway generate --check)

.PHONY: format
format: $(VENV)/.dev ## Format the code and repair what ruff can repair.
	@$(BIN)/ruff check --fix --quiet .
	@$(BIN)/ruff format .

.PHONY: bench
bench: setup ## Measure against the peers and print a table of ratios.
	@for bench in tests/bench/bench_*.py; do PYTHONPATH=. $(BIN)/python "$$bench"; done

.PHONY: setup
setup: $(VENV)/.dev ## Make .venv and install the foreign programs that tests talk to.
	@tests/peers/install.sh || { status=$$?; \
	  if [[ -n "$${CI:-}" || $$status -ne 3 ]]; then exit 1; fi; \
	  echo 'Going on: tests that need them are skipped.'; }

.PHONY: lock
lock: $(VENV)/.dev ## Write requirements*.txt anew from pyproject.toml.
	$(call step,requirements-dev.txt,$(PIP_COMPILE) --extra dev --output-file requirements-dev.txt pyproject.toml)
	$(call step,requirements.txt,$(PIP_COMPILE) --constraint requirements-dev.txt --output-file requirements.txt pyproject.toml)
	$(call step,requirements-audit.txt,$(LOCK) --output-file requirements-audit.txt requirements-audit.in)

# No index, host or option of the machine that locks gets into the files. What builds the project itself is
# locked with it, so that installing it needs no network of its own. UPGRADE=1 takes the newest versions.
LOCK = $(BIN)/pip-compile --quiet --generate-hashes --strip-extras --allow-unsafe --no-header \
	--no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-emit-options $(if $(UPGRADE),--upgrade)
PIP_COMPILE = $(LOCK) --build-deps-for editable --extra fast

.PHONY: audit
audit: $(VENV)/.runtime $(VENV)-audit/.ready ## Write licences and an SBOM to dist/, and ask for known holes of the locked libraries.
	@$(BIN)/python -m tests.supply.audit --tools $(VENV)-audit/bin --output dist

.PHONY: wheels
wheels: $(VENV)/.runtime ## Fetch the locked libraries into dist/wheels, for a machine without a network.
	$(call step,dist/wheels,$(PIP) download --require-hashes --only-binary :all: --requirement requirements.txt --dest dist/wheels)

.PHONY: clean
clean: ## Remove .venv and everything that was made by a tool.
	@rm -rf $(VENV) $(VENV)-newest $(VENV)-audit build dist htmlcov .coverage .coverage.* .hypothesis .mypy_cache .pytest_cache .ruff_cache \
	  .import_linter_cache *.egg-info
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Whether `make PYTHON=...` names another interpreter than .venv was made with: then that environment is made anew.
ifneq ($(PYTHON),)
  which_python = $(shell exec 2>/dev/null; "$(1)" -c 'import sys; print(sys.version, sys.base_prefix)')
  ifneq ($(call which_python,$(PYTHON)),$(call which_python,$(BIN)/python))
    .PHONY: $(BIN)/python
    ANOTHER_PYTHON := $(BIN)/python
  endif
endif

# The environment. Debian has Python without the module that makes environments; it is installed if it may be.
$(BIN)/python:
	@python=; \
	for candidate in $(or $(PYTHON),python3.11 python3.12 python3.13 python3.14 python3); do \
	  if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [[ -z $$python ]]; then \
	  echo '$(if $(PYTHON),$(PYTHON) is not a Python,There is no Python) 3.11 or newer. Install one (apt-get install python3) or name it: make PYTHON=/path/to/python3.11' >&2; exit 1; \
	fi; \
	version=$$("$$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
	if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
	  tests/peers/install.sh "python$$version-venv" || { \
	    echo "$$python cannot make a virtual environment: python$$version-venv is missing (apt-get install python$$version-venv)." >&2; exit 1; }; \
	fi; \
	echo "Making $(VENV) with Python $$version:"; \
	rm -rf $(VENV); "$$python" -m venv $(VENV)

# $(call install,lock file): the locked packages, then this clone itself, editable.
define install
	$(call step,install $(1),$(PIP) install --require-hashes --requirement $(1))
	$(call step,install this clone,$(PIP) install --no-deps --no-build-isolation --editable .)
endef

# Order-only: a newer interpreter link is no reason to install again, but another interpreter is.
$(VENV)/.runtime: requirements.txt pyproject.toml $(ANOTHER_PYTHON) | $(BIN)/python
	$(call install,requirements.txt)
	@touch $@

$(VENV)/.dev: requirements-dev.txt pyproject.toml $(ANOTHER_PYTHON) | $(BIN)/python
	$(call install,requirements-dev.txt)
	@touch $@ $(VENV)/.runtime

$(VENV)-audit/.ready: requirements-audit.txt $(ANOTHER_PYTHON) | $(BIN)/python
	@rm -rf $(VENV)-audit; $(BIN)/python -m venv $(VENV)-audit
	$(call step,install requirements-audit.txt,$(VENV)-audit/bin/python -m pip --disable-pip-version-check --quiet --quiet install --require-hashes --requirement requirements-audit.txt)
	@touch $@
