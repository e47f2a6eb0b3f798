PYTHON ?= python3.11
BIN := .venv/bin

.PHONY: workbook test lab lint lock

workbook: .venv/installed
	$(BIN)/python -m dmsrd_lite run papermill_runs/plans/quick.toml

test: .venv/installed lint
	$(BIN)/python -m pytest

lab: .venv/installed
	$(BIN)/jupyter lab notebooks

lint: .venv/installed
	$(BIN)/ruff check dmsrd_lite tests notebooks && $(BIN)/ruff format --check dmsrd_lite tests notebooks && $(BIN)/nbstripout --verify $$(git ls-files '*.ipynb')

lock: .venv/installed
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu$$//' > requirements.lock

.venv/installed: pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv .venv || python3 -m venv .venv
	$(BIN)/python -m pip install -e '.[workbook,test]' -c requirements.lock
	touch $@
