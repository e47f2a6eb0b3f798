PYTHON ?= python3.11
BIN := .venv/bin
CODE := dmsrd_lite tests notebooks papermill_runs/peers

.PHONY: workbook test verify lab book lint lock results

workbook: .venv/installed
	$(BIN)/python -m dmsrd_lite run papermill_runs/plans/quick.toml --workers 2

test: .venv/installed lint
	$(BIN)/python -m pytest -m "not verify" -n 2 --maxschedchunk 1 --durations 12

verify: .venv/installed
	$(BIN)/python -m pytest -m verify -n 2 --maxschedchunk 1 --durations 12

lab: .venv/installed
	$(BIN)/python -m dmsrd_lite lab $(ROOT)

book: .venv/installed
	$(BIN)/python -m dmsrd_lite book

lint: .venv/installed
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/nbstripout --verify $$(git ls-files 'notebooks/*.ipynb') || \
	  { echo "a notebook holds outputs: run $(BIN)/nbstripout on it, and read in the copy that 'make lab' makes"; exit 1; }

results: .venv/installed
	$(BIN)/python -m dmsrd_lite results

lock: .venv/installed
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu$$//' > requirements.lock

.venv/installed: pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv .venv || python3 -m venv .venv
	$(BIN)/python -m pip install -e '.[workbook,test]' -c requirements.lock
	touch $@
