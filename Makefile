# Each target sets up everything that it needs (setup.sh), so that it works on a fresh machine.
# The stamp holds the folder that was set up: a moved or copied folder is set up again, because .venv does not move.
venv   := .venv
python := $(venv)/bin/python
stamp  := $(venv)/.ready
JOBS   := 2

.DEFAULT_GOAL := help
.PHONY: help demo check test clean FORCE

help:
	@echo 'make demo    render and relight the example scene'
	@echo 'make check   format, lint and types'
	@echo 'make test    run the tests (ARGS="-k name" passes options to pytest)'
	@echo 'make clean   remove the Python environment; the next make sets it up again'

demo: $(stamp)
	$(python) examples/demo.py $(ARGS)

check: $(stamp)
	$(venv)/bin/ruff format --check .
	$(venv)/bin/ruff check .
	$(venv)/bin/basedpyright --pythonpath $(python)

# Two processes: Mitsuba uses all cores inside each, and what is left idle by one the other takes.
# Compiled Python is kept, also where the environment asks for none: a hundred processes start here.
test: export PYTHONDONTWRITEBYTECODE =
test: export PYTHONPYCACHEPREFIX = $(CURDIR)/$(venv)/.pycache
test: $(stamp)
	$(python) -m pytest -q -n $(JOBS) --dist loadfile $(ARGS)

clean:
	rm -rf $(venv)

$(stamp): pyproject.toml setup.sh
	./setup.sh

ifneq ("$(CURDIR)","$(shell test -x $(python) && cat $(stamp) 2>/dev/null)")
$(stamp): FORCE
endif
