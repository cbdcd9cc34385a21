# Every target sets itself up: a virtual environment in VENV, the package in it (editable), and then the work.
#   make demo          the paper's experiment, with a report in out/demo
#   make test          the tests (ARGS="-k name" for some of them), 7 to 20 minutes on two cores
#   make lint types    style, import direction, types (of the tests too)
#   make bench soak    speed; the long statistical and fault tables
#   make figures       the pictures of the documentation
#   make docs          the tests of pages, notebooks and examples; the site in out/site, and its check: links, names,
#                      nothing from elsewhere, widths of pages
#   make pages         the pages of docs/ that are made from the program
#   make wheel-check   what a release would ship, built from a clean clone
#   make dist          wheel and sdist, built twice and compared bit for bit
#   make oldest        the fast tests against the oldest versions of dependencies that are allowed

VENV ?= .venv
BENCH_VENV ?= $(VENV)-bench
OLDEST_VENV ?= $(VENV)-oldest
ARGS ?=
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: demo test soak bench figures lint types docs pages wheel-check dist oldest clean

demo: $(VENV)/.installed
	$(BIN)/phasemark demo --out out/demo --force

test: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not soak and not docs" $(ARGS)

soak: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist worksteal -m soak $(ARGS)

bench: $(BENCH_VENV)/.installed-bench
	$(BENCH_VENV)/bin/python benchmarks/run.py $(ARGS)

figures: $(BENCH_VENV)/.installed-bench
	$(BENCH_VENV)/bin/python docs/figures.py --runs

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.installed-test
	mkdir -p .typing
	ln -sfn .. .typing/phasemark
	$(BIN)/mypy
	$(BIN)/mypy --config-file tests/mypy.ini

docs: $(VENV)/.installed-docs
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "docs and not soak" $(ARGS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	$(BIN)/python docs/site/check.py out/site

pages: $(VENV)/.installed-test
	$(BIN)/python docs/commands.py
	$(BIN)/python docs/site/generated_pages.py

wheel-check: $(VENV)/.installed-test
	$(BIN)/python .ci/wheel_check.py

dist: $(VENV)/.installed-test
	$(BIN)/python .ci/distributions.py dist

oldest: $(BIN)/python
	$(BIN)/python .ci/oldest.py $(OLDEST_VENV) $(ARGS)

clean:
	rm -rf build dist out .typing .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis *.egg-info
	find __init__.py __main__.py cli.py inputs landmarks render data matcher tests -name __pycache__ -prune -exec rm -rf {} +

# A name like python3.12 may exist and still not run (version managers leave such shims), so each candidate is tried.
# PYTHON=/path/to/python overrides the choice. A leftover build/ would be shipped again by the next install.
$(BIN)/python:
	@for python in $(PYTHON) python3.13 python3.12 python3.11 python3 python; do \
	    if "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        echo "creating $(VENV) with $$("$$python" --version)"; \
	        exec "$$python" -m venv "$(VENV)"; \
	    fi; \
	done; \
	echo "phasemark needs Python 3.11 or newer with its venv module, and found none." \
	     "On Debian: apt-get install python3 python3-venv. Elsewhere: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; \
	exit 1

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	rm -rf build
	$(PIP) install --editable .
	touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	rm -rf build
	$(PIP) install --editable '.[test]'
	touch $(VENV)/.installed $@

$(VENV)/.installed-docs: pyproject.toml $(VENV)/.installed-test
	$(PIP) install --editable '.[test,docs]'
	touch $@

# Open3D brings half a hundred packages, a pytest plugin among them, so the benchmark has an environment of its own.
$(BENCH_VENV)/.installed-bench: pyproject.toml
	@$(MAKE) --no-print-directory VENV=$(BENCH_VENV) $(BENCH_VENV)/.installed
	$(BENCH_VENV)/bin/python -m pip --disable-pip-version-check --quiet install --editable '.[bench]' \
	    || echo "Open3D cannot be installed here: its rows will be missing" >&2
	touch $@
