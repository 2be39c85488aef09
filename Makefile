# make setup        make .venv (and install what this machine lacks)
# make quickstart   set up, then sew one stitch and train one policy: outputs/quickstart/report.html
# make released     set up, then build the released policies anew (hours; ONLY=grasp,hlp)
# make test         set up, then pass the tests
# make check        lint, format, types, import rule, tests
# make figures      count what CONTRIBUTING.md asks of the sources
# make format       rewrite the sources in the house's format
# make docs         build the documentation as a site: build/docs/index.html
# make lock         rewrite requirements.lock (UPGRADE=1: newest versions allowed)

BIN := .venv/bin
# Without compiled bytecode each worker process compiles torch and timm anew.
unexport PYTHONDONTWRITEBYTECODE
PYTEST_ARGS ?= -n 2 --dist loadfile

.PHONY: setup quickstart released test lint check figures docs format lock
.NOTPARALLEL:

setup:
	@sh scripts/setup.sh

quickstart: setup
	$(BIN)/surgicai-vision quickstart

released: setup
	$(BIN)/surgicai-vision release $(if $(ONLY),--only $(ONLY))

test: setup
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	@$(BIN)/python scripts/figures.py

check: lint test

figures:
	@$(BIN)/python scripts/figures.py

docs: setup
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/docs
	@echo "docs: build/docs/index.html"

format: setup
	$(BIN)/ruff check --fix-only --exit-zero .
	$(BIN)/ruff format .

lock: setup
	sh scripts/lock.sh
