# `make roa` proves and checks the shipped policy, `make test` runs the suite, `make docs` builds the site into build/site.
PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: setup roa test fast lint docs dist gallery shares tradeoff paper paper-proved coq clean

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -c constraints.txt -e '.[controllers,test]'
	touch $@

roa: setup
	$(BIN)/certify roa --policy examples/policies/pendulum.pt --out out/pendulum

test: setup
	$(BIN)/pytest -n 2 --dist worksteal

fast: setup
	.ci/fast

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

dist: setup
	.ci/dist

gallery: setup
	$(BIN)/python docs/gallery/draw.py
	$(BIN)/python docs/gallery/gain.py

shares: setup
	$(BIN)/python docs/gallery/shares.py

tradeoff: setup
	$(BIN)/python docs/how-to/tradeoff.py

# The runs themselves are not in the tree; docs/paper.md says how to get them.
RUNS ?= runs

paper: setup
	$(BIN)/python docs/paper/draw.py $(RUNS)
	$(BIN)/python docs/paper/table.py

paper-proved: setup
	$(BIN)/python docs/paper/proved.py $(RUNS)

# The theory behind `certify prove-in-coq`; needs Coq with its library Interval, which nothing else here does.
coq:
	rm -rf build/coq && mkdir -p build/coq && cp certify/certificates/coq/theory/* build/coq
	cd build/coq && for file in $$(grep '[.]v$$' _CoqProject); do coqc -q $$file || exit 1; done

clean:
	rm -rf .venv out build *.egg-info
