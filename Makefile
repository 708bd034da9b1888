# Installs into .venv, plays the example, runs the tests and the checks.

PYTHON ?= python3
BIN := .venv/bin
CORE := $(wildcard firmware/include/vibrocast/*.h firmware/src/*/*.[ch] firmware/ports/python/*.[ch])
SOURCES := pyproject.toml hatch_build.py $(CORE)
# Generated files need no layout.
C_SOURCES := $(filter-out %_tables.c %/actuator_tables.h %/vc_messages.c %/vc_messages.h %/protocol.h,$(wildcard firmware/*/*.[ch] firmware/*/*/*.[ch] firmware/*/*/*/*.[ch])) $(wildcard tests/*/*.c)

# A comma in an argument of `call`.
, := ,

CHECKPOINTS ?= trained
DATA ?= recordings

.PHONY: install play test test-long lint docs lock sbom fuzz mutants firmware models

# $(call installed,LOCK,EXTRAS): the packages of a lock, by their hashes, then vibrocast, and what the lock leaves out.
# Other bytes than those of the lock are an error; versions that the package index lacks are not.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
define installed
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo 'installing what $(1) pins'
	@if $(PIP) --require-hashes --requirement $(1) 2> .venv/pip.log; then \
	    $(PIP) --no-build-isolation --editable '.[$(2)]'; \
	elif grep -q 'DO NOT MATCH THE HASHES' .venv/pip.log; then \
	    cat .venv/pip.log; \
	    echo "To trust your package index, run: $(BIN)/python -m pip install --editable '.[$(2)]'"; \
	    exit 1; \
	else \
	    echo '$(1) does not fit this Python, system or package index: installing the newest versions that fit.'; \
	    $(PIP) --editable '.[$(2)]'; \
	fi
endef

install: .venv/installed

.venv/installed: $(SOURCES) requirements.txt
	$(call installed,requirements.txt,plot)
	touch $@

.venv/installed-for-tests: $(SOURCES) requirements-dev.txt
	$(call installed,requirements-dev.txt,audio$(,)bench$(,)docs$(,)firmware$(,)formats$(,)keys$(,)lab$(,)study$(,)test$(,)train)
	touch $@ .venv/installed

play: install
	$(BIN)/vibrocast play examples/oak.wav --plot oak.png --report oak.json

# The core, and one path through each product, in a few minutes.
test: .venv/installed-for-tests
	$(BIN)/python -m pytest -m "not slow"

# The rest: sanitisers, emulated boards in full, other processes, long training and planning.
test-long: .venv/installed-for-tests
	$(BIN)/python -m pytest -m slow

lint: .venv/installed-for-tests
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/codespell
	$(BIN)/python -m tests.lint
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $(C_SOURCES)

# The documentation site, in site/; a broken link or a missing docstring fails.
docs: .venv/installed-for-docs
	$(BIN)/ruff check --quiet --select D100,D101,D102,D103,D104
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

.venv/installed-for-docs: $(SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(PIP) --editable '.[docs]'
	touch $@

# Refreshes the pins; `pip install uv` first. Pins that still fit stay; to move one, delete its lines before.
# requirements.txt is the part of requirements-dev.txt that `make install` needs, with the packages that build vibrocast.
LOCK := requirements-dev.txt
COMPILE := uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-header --python-version 3.11
lock:
	set -e; \
	head=$$(grep '^#' $(LOCK)); \
	$(COMPILE) --extra audio --extra bench --extra firmware --extra formats --extra keys --extra lab --extra study --extra test --extra docs --output-file $(LOCK) pyproject.toml; \
	printf 'hatchling\nziglang\n' | $(COMPILE) --constraint $(LOCK) --extra plot --output-file requirements.txt pyproject.toml -; \
	printf '%s\n' "$$head" | cat - $(LOCK) > $(LOCK).new; \
	mv $(LOCK).new $(LOCK)

# The bill of materials of a release, in CycloneDX; `pip install cyclonedx-bom` first.
sbom:
	mkdir -p dist
	cyclonedx-py requirements requirements.txt --pyproject pyproject.toml --output-reproducible --output-file dist/vibrocast.cdx.json

# Looks for bytes that the firmware does not take, for an hour on all processors; needs clang.
FUZZ_SECONDS ?= 3600
fuzz: .venv/installed-for-tests
	$(BIN)/python -m tests.firmware.fuzzing --seconds $(FUZZ_SECONDS)

# Faults that the tests must notice; takes an hour.
mutants: .venv/installed-for-tests
	$(BIN)/python -m tests.mutants

# Every program of the controller, into firmware/build, and what the images take; firmware/README.md.
firmware: .venv/installed-for-tests
	$(BIN)/python -m vibrocast.firmware.build
	$(BIN)/python -m vibrocast.firmware.build --sizes

# Images hold the integer network and the ONNX graph, so that a controller can choose.
models: .venv/installed-for-tests
	set -e; for trained in $(CHECKPOINTS)/*/checkpoint.pt; do \
	    name=$$(basename $$(dirname $$trained)); \
	    case $$name in eva-16-perceptual-*) examples=eva-16-perceptual;; *) examples=eva;; esac; \
	    $(BIN)/vibrocast export $$trained --name $$name --out models/$$name --data $(DATA) --runtime both \
	        --training-command "vibrocast train examples/$$examples.toml --data $(DATA)"; \
	done
