# One command for everything. `make` alone lists the targets.

SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: dist test-release gallery words check-words papers measured verification scatter coverage drift diagnosis mutations help demo size test test-quick test-studies test-oldest \
	test-versions fuzz kills bench-kills registry-stress check check-lint check-types check-code check-docs bench bench-guard docs clean

PYTHON ?= python3
PYTHONS ?= python3.12 python3.13
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
FOR_DEMO := $(VENV)/.demo
comma := ,
BENCH := build/bench-venv/bin
MEASURED := build/bench-venv/.installed

# The measured data sets are optional: tests that need them skip without them.
ifeq ($(MWDCAL_DATA),)
ifneq ($(wildcard ../shared/data/.),)
export MWDCAL_DATA := $(abspath ../shared/data)
endif
endif

# Compiled once, not by each of the hundreds of processes that the tests start.
unexport PYTHONDONTWRITEBYTECODE

# One BLAS thread: repeatable last digits, and no contention between test workers.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1

# Tests of the numbers, of one command and of the fleet: what most mistakes are noticed by.
QUICK_TESTS := vectors observables models derivatives estimate efficiency expectations calibrate \
	notation refusals files_table cli_verify fleet architecture

# First words of every recipe: stop at the first error, say the seconds at the end.
CLOCK = set -e; start=$$(date +%s); \
	trap 'code=$$?; echo "make $@: $$(($$(date +%s) - start)) s"; exit $$code' EXIT

SPHINX := $(BIN)/sphinx-build -q -W --keep-going -d build/doctrees

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 20
	@echo "Another interpreter: make PYTHON=python3.12 test, after make clean"

size: ## print code lines and modules by room
	@$(PYTHON) tests/size.py

demo: $(FOR_DEMO) ## calibrate the example tool, verify it, write its report (under a minute)
	@$(CLOCK); mkdir -p build/demo; \
	run() { echo; echo "$$ mwdcal $$*"; $(BIN)/mwdcal "$$@"; }; \
	run calibrate examples/servo/run.csv --tool examples/servo/tool.toml \
		-o build/demo/tool.json --report build/demo/tool.html; \
	run verify build/demo/tool.json examples/servo/rolltest.csv; \
	echo; echo "report: build/demo/tool.html"

test: $(INSTALLED) ## run the tests on all cores
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python -m pytest -q -rs --durations=25 --durations-min=5 \
		-n auto --dist worksteal

test-quick: $(INSTALLED) ## run the most telling tests (under a minute)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python $(QUICK_RUN)

test-studies: $(INSTALLED) ## run the large versions of tests that are made small in the others (two minutes)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python -m pytest -q -rs -n auto -m study

# What the quick tests need besides the package and its extras.
TESTED_WITH := pytest pytest-xdist hypothesis jsonschema allantools pandas polars
INSTALL := -m pip install --quiet --disable-pip-version-check
QUICK_RUN := -m pytest -q -n auto -m "not slow" $(QUICK_TESTS:%=tests/test_%.py)

test-oldest: $(INSTALLED) ## run the quick tests with the lowest versions that pyproject.toml allows
	@$(CLOCK); mkdir -p build; $(BIN)/python tests/oldest_versions.py > build/oldest.txt; \
	$(PYTHON) -m venv build/oldest; \
	build/oldest/bin/python $(INSTALL) -c build/oldest.txt -e '.[all]' $(TESTED_WITH); \
	$(ONE_THREAD) build/oldest/bin/python $(QUICK_RUN) -W ignore::DeprecationWarning

test-versions: ## run the quick tests with other interpreters (PYTHONS="python3.12 python3.13")
	@$(CLOCK); for python in $(PYTHONS); do \
		$$python --version >/dev/null 2>&1 || { echo "skipped: $$python is not installed"; continue; }; \
		place=build/$$(basename $$python); $$python -m venv $$place; \
		$$place/bin/python $(INSTALL) -c constraints.txt -e '.[all]' $(TESTED_WITH); \
		$$place/bin/python --version; $(ONE_THREAD) $$place/bin/python $(QUICK_RUN); \
	done

dist: docs ## build sdist, wheel and the documentation as an archive into dist
	@$(CLOCK); rm -rf dist; $(PYTHON) -m venv build/builder; build/builder/bin/python $(INSTALL) build; \
	build/builder/bin/python -m build --quiet; \
	version=$$(sed -n 's/^version: //p' CITATION.cff); \
	tar -czf dist/mwdcal-docs-$$version.tar.gz --transform "s,^docs,mwdcal-docs-$$version," -C build docs; ls -l dist

test-release: ## install dist's wheel in empty environments, lowest and newest, validate it, run the README (PYTHONS="…")
	@$(CLOCK); $(PYTHON) -m venv build/builder; build/builder/bin/python $(INSTALL) uv; \
	PATH="$(CURDIR)/build/builder/bin:$$PATH" $(PYTHON) tests/release.py dist/*.whl $(PYTHONS)

fuzz: $(INSTALLED) ## run random commands on damaged files (SEEDS=0:100000 MINUTES=10), findings into build/fuzz
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python tests/fuzz.py --seeds $(or $(SEEDS),0:100000) \
		--minutes $(or $(MINUTES),10) --jobs $$(nproc 2>/dev/null || echo 2)

mutations: $(INSTALLED) ## change one operator or constant in so many (EVERY=40) and list what no test notices
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python tests/mutation_run.py --every $(or $(EVERY),40)

kills: $(INSTALLED) ## end commands at random moments (COUNT=1000) and check what they leave
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python tests/kills.py --count $(or $(COUNT),1000) --seed $(or $(SEED),1)

bench-kills: $(INSTALLED) ## end server, source and browser of a bench at random moments (COUNT=200) and check what is left
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python tests/bench_kills.py --count $(or $(COUNT),200) --seed $(or $(SEED),1)

registry-stress: $(INSTALLED) ## write to registries by 50 processes, end some at random, and check what is left (two minutes)
	@$(CLOCK); $(ONE_THREAD) PYTHONPATH=tests $(BIN)/python tests/registry_stress.py \
		--writers 50 --seconds 60 --kills $(or $(COUNT),100)

check: $(INSTALLED) ## lint, format, types, architecture, doctests, docs, words; two at a time
	@$(CLOCK); $(MAKE) --no-print-directory --keep-going -j2 $(WHOLE) check-types check-docs check-lint check-code check-words

# The parts of `make check` print what they find together, where make can do that.
WHOLE := $(if $(filter output-sync,$(.FEATURES)),--output-sync=target)

check-lint: $(INSTALLED)
	@$(CLOCK); $(BIN)/ruff check .; $(BIN)/ruff format --check .

check-types: $(INSTALLED)
	@$(CLOCK); $(BIN)/mypy

check-code: $(INSTALLED)
	@$(CLOCK); $(BIN)/python -m pytest -q tests/test_architecture.py; \
	$(ONE_THREAD) $(BIN)/python -m pytest -q --doctest-modules src; \
	$(ONE_THREAD) $(BIN)/python -m pytest -q --doctest-glob='*.md' docs

check-words: $(INSTALLED)
	@$(CLOCK); $(BIN)/python tests/words.py; $(BIN)/python examples/gallery/gallery.py --check

words: ## count the words of the documentation, page by page
	@$(PYTHON) tests/words.py --count

check-docs: $(INSTALLED)
	@$(CLOCK); $(SPHINX) -b html docs build/docs; $(SPHINX) -b man docs build/man; \
	cmp build/man/mwdcal.1 docs/mwdcal.1 || { echo "docs/mwdcal.1, the manual page, is old: make docs"; exit 1; }

bench: $(MEASURED) ## time mwdcal against SciPy and other packages, write docs/evidence/benchmarks.md (QUICK=1: two minutes)
	@$(CLOCK); $(ONE_THREAD) PYTHONPATH=tests $(BENCH)/python benchmarks/bench.py \
		$(if $(QUICK),--quick --output build/benchmarks)

bench-guard: $(INSTALLED) ## compare the speed of what users wait for with a reference and the last release (KEEP=1: store it; MOST=2: on another machine)
	@$(CLOCK); $(ONE_THREAD) PYTHONPATH=benchmarks $(BIN)/python benchmarks/guard.py $(if $(KEEP),--keep) \
		$(if $(MOST),--most $(MOST))

measured: $(INSTALLED) ## calibrate the measured sets (MWDCAL_DATA) and rewrite docs/evidence/measured.md
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/measured/measured.py

papers: $(INSTALLED) ## recompute the papers and rewrite their pages and figures (a minute or two)
	@$(CLOCK); for name in moradi moosavi ivanov; do $(ONE_THREAD) $(BIN)/python examples/papers/$$name.py; done

verification: $(INSTALLED) ## count wrong verdicts of simulated roll tests and rewrite docs/evidence/verification.md (two minutes)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/verification/verification.py

coverage: $(INSTALLED) ## compare stated uncertainties with simulated errors and rewrite docs/evidence/coverage (STUDY=ladders: one page)
	@$(CLOCK); for study in $(or $(STUDY),$(filter-out world,$(basename $(notdir $(wildcard examples/coverage/*.py))))); do \
		$(ONE_THREAD) $(BIN)/python examples/coverage/$$study.py; done

drift: $(INSTALLED) ## test for changes of simulated tools and rewrite docs/evidence/drift-tables.md (twenty minutes)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/drift/drift.py

scatter: $(INSTALLED) ## compare what plans state with simulated calibrations and rewrite docs/evidence/scatter.md (a quarter of an hour)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/planning/scatter.py

diagnosis: $(INSTALLED) ## name faults of simulated tools and rewrite docs/evidence/diagnosis.md (half an hour; COUNT=100)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/diagnosis/diagnosis.py --count $(or $(COUNT),1000)

gallery: $(INSTALLED) ## take the pictures of all pages for docs/gallery.md (a minute; needs Chromium and pdftoppm)
	@$(CLOCK); $(ONE_THREAD) $(BIN)/python examples/gallery/gallery.py

docs: $(INSTALLED) ## build the documentation into build/docs, and the manual page docs/mwdcal.1
	@$(CLOCK); $(SPHINX) -b html docs build/docs; $(SPHINX) -b man docs build/man; \
	cp build/man/mwdcal.1 docs; \
	echo "documentation: build/docs/index.html"

clean: ## remove everything that can be made again
	@$(CLOCK); rm -rf build dist $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis; \
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# An environment in $(1) with the package and $(2); stops where Python is missing or too old.
define INSTALL_INTO
start=$$(date +%s); \
	command -v $(PYTHON) >/dev/null 2>&1 || { \
		echo "mwdcal needs Python 3.11 or newer; '$(PYTHON)' was not found. Name one: make PYTHON=/path/to/python3" >&2; exit 1; }; \
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		found=$$($(PYTHON) -c 'import sys; print(sys.version.split()[0])'); \
		echo "mwdcal needs Python 3.11 or newer; '$(PYTHON)' is $$found. Name another: make PYTHON=/path/to/python3" >&2; exit 1; }; \
	set -e; echo "installing $(3) into $(1)"; \
	$(PYTHON) -m venv $(1); \
	$(1)/bin/python $(INSTALL) -c constraints.txt $(2); \
	touch $@; echo "installed: $$(($$(date +%s) - start)) s"
endef

$(FOR_DEMO): pyproject.toml constraints.txt
	@$(call INSTALL_INTO,$(VENV),-e '.[report]',mwdcal and what draws its pages)

$(INSTALLED): pyproject.toml constraints.txt
	@$(call INSTALL_INTO,$(VENV),-e '.[all$(comma)dev]',mwdcal and what its developers need (minutes)); touch $(FOR_DEMO)

$(MEASURED): pyproject.toml constraints.txt benchmarks/requirements.txt
	@$(call INSTALL_INTO,build/bench-venv,-e '.[all]' -r benchmarks/requirements.txt,mwdcal and the alternatives)
