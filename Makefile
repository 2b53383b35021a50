# Every target makes .venv if it is missing, updates it if pyproject.toml has changed, and makes it
# anew if the pins have changed, because pip keeps packages that are no longer pinned.
PYTHON ?= python3
ARGS ?=
PYTEST_ARGS ?= -n auto --maxprocesses 8 --dist worksteal
PACKAGE ?= mdp
N ?= 25
SEED ?= 0

BIN := .venv/bin
STAMP := .venv/.installed
PINS := constraints.txt requirements.txt
# One thread per process: small networks are slower with more, and tests run in parallel.
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help train test golden size peers lint style types types-elsewhere format bench mutants docs images wheel clean

help: ## List the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1|\2/p' $(firstword $(MAKEFILE_LIST)) | \
	  awk -F'|' '{ printf "%-12s %s\n", $$1, $$2 }'

train: $(STAMP) ## Train PPO on the warehouse, or as in ARGS="--env ... --algo ..."
	$(BIN)/python train.py $(if $(strip $(ARGS)),$(ARGS),--env Warehouse-v0 --algo ppo)

test: peers ## Run the whole test suite; PYTEST_ARGS replaces its options
	$(BIN)/python -m pytest $(PYTEST_ARGS)

golden: $(STAMP) ## Compare results with tests/golden/golden.json; ARGS="--record" replaces it
	$(BIN)/python tests/golden $(ARGS)

size: $(STAMP) ## Count lines and files against the limits in CONTRIBUTING.md
	@$(BIN)/python docs/scripts/sizes.py

peers: $(STAMP) ## Install rl_zoo3, which tests need, in .venv/peers
	@$(BIN)/python tests/peers/peer_environment.py

lint: style types types-elsewhere ## Check style, formatting, types and import contracts

# Separate targets, so that make -j2 runs them in parallel.
style: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff check --preview --select PLW1514 rl_yardstick # Windows does not take text for UTF-8
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python docs/scripts/english.py

types: $(STAMP)
	$(BIN)/python -m mypy

types-elsewhere: $(STAMP)
	$(BIN)/python -m mypy --platform win32 --no-warn-unreachable --cache-dir .mypy_cache/win32 rl_yardstick

format: $(STAMP) ## Format the code, and apply ruff's fixes
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

bench: peers ## Time everything, with one round
	$(BIN)/python benchmarks/timing.py --rounds 1 tabular networks bandits evaluation planning processes

mutants: $(STAMP) ## Count the deliberate errors that tests catch: PACKAGE=mdp N=25 SEED=0
	$(BIN)/python tests/mutation rl_yardstick/$(PACKAGE) -n $(N) --seed $(SEED)

docs: $(STAMP) ## Build the site, build/site/index.html, and check its links
	rm -rf build/site
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/site
	$(BIN)/python docs/scripts/check_links.py build/site
	$(BIN)/python docs/scripts/fill_tables.py --check

images: $(STAMP) ## Redraw the pictures of README and docs; one needs Chromium
	$(BIN)/python docs/scripts/draw_images.py
	$(BIN)/python docs/images/bandits.py

wheel: $(STAMP) ## Build dist/, install the wheel in a new environment, and test it
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	PYTHON=$(BIN)/python .ci/try-wheel dist/*.whl

clean: ## Remove caches and builds; .venv and logs/ stay
	rm -rf build dist *.egg-info .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

# A study of all agents with tables and of PPO, whose machine code is cached for later trainings.
WARM_UP = runs=$$(mktemp -d) && $(BIN)/python compare.py --env Warehouse-v0 --algos \
  qlearning ppo sarsa expected_sarsa double_qlearning monte_carlo dyna_q n_step_sarsa sarsa_lambda \
  q_lambda n_step_tree_backup off_policy_monte_carlo dyna_q_plus prioritized_sweeping r_max \
  qlearning_ucb --engine compiled --seeds 1 -n 2048 --jobs 1 --no-report -f "$$runs"; rm -rf "$$runs"

# The stamp is written last, so a failed set-up is repeated.
$(STAMP): pyproject.toml $(PINS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "Yardstick needs Python 3.11 or newer; $(PYTHON) is not. Name one: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Setting up .venv (once, some minutes: PyTorch is large)"
	@cat $(PINS) 2>/dev/null | cmp -s - .venv/pins || \
	  { $(PYTHON) -m venv --clear .venv && cat $(PINS) >.venv/pins; }
	@$(BIN)/python -m pip install --quiet --no-deps -r requirements.txt
	@$(BIN)/python -m pip install --quiet --no-build-isolation -c constraints.txt -e '.[dev]'
	@touch $@
	@[ -n "$$CI" ] || nohup nice sh -c '$(WARM_UP)' </dev/null >/dev/null 2>&1 &
