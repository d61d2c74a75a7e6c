# make demo    SLAM on the built-in scene: trajectory, mesh, pictures and a table under outputs/
# make test    lint, then all tests
# make lint    format, types, import layers             make format  rewrite the sources in that format
# make asan    the op tests under AddressSanitizer and UBSan
# make build   native parts in place                    make wheel   dist/*.whl
# make clean   remove what was built; .venv stays
#
# Each sets up .venv in this folder first and reuses what stands. Variables:
#   PYTHON=python3.12       interpreter for .venv, 3.10 or newer
#   TORCH="torch==2.12.0"   what pip installs as torch; the default is the CPU build where there is no NVIDIA GPU
#   SNH_CUDA=auto|on|off    CUDA kernels where nvcc is found, always, never
#   ARGS="..."              more arguments for snh-slam demo, or for pytest
VENV := .venv
BIN := $(VENV)/bin
CXX ?= c++
ARGS ?=
NATIVE_SOURCES := CMakeLists.txt setup.py $(wildcard csrc/*/*)
FORMATTED := $(wildcard csrc/*/*.h csrc/*/*.cpp csrc/*/*.cu csrc/*/*.cuh tests/cpp/*.cpp)
OP_TESTS := $(wildcard $(patsubst csrc/%,tests/test_%*.py,$(wildcard csrc/*))) tests/test_cuda_kernels.py
export PYTHON TORCH SNH_CUDA

.DELETE_ON_ERROR:
.PHONY: demo test lint format asan build wheel clean
READY := build/.native $(VENV)/.installed

demo: $(READY)
	@echo "== demo: the built-in scene"
	@$(BIN)/snh-slam demo $(ARGS)

test: lint
	@echo "== tests"
	@OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --maxprocesses 8 --dist loadfile $(ARGS)

lint: $(READY)
	@echo "== lint: ruff, clang-format, mypy, import layers"
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --quiet --check . && $(BIN)/clang-format --dry-run -Werror $(FORMATTED) || \
	  { echo "not formatted; run: make format"; exit 1; }
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/python tools/check_layers.py

format: $(READY)
	@$(BIN)/ruff format --quiet .
	@$(BIN)/clang-format -i $(FORMATTED)

# A second copy of the package with instrumented libraries; PYTHONPATH puts it before the one in .venv. The runtime
# libraries must be the first that the interpreter loads. Leaks are not counted: Python keeps objects until it exits.
asan: $(READY)
	@echo "== sanitizers: the op tests with an instrumented build"
	@SNH_CUDA=off SNH_SANITIZE=address,undefined SNH_BUILD=build/asan/native \
	  $(BIN)/python setup.py --quiet build --build-base build/asan --build-lib build/asan/lib
	@LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libstdc++.so.6)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONPATH=build/asan/lib OMP_NUM_THREADS=1 \
	  $(BIN)/pytest -n auto --maxprocesses 8 --dist loadfile $(OP_TESTS) $(ARGS)

build: $(VENV)/.requirements
	@$(BIN)/python setup.py --quiet build_ext --inplace
	@touch build/.native

wheel: $(READY)
	@rm -rf build/lib.*
	@SNH_BUILD=$(CURDIR)/build/wheel SNH_CUDA_ARCHITECTURES=all $(BIN)/pip wheel --quiet --no-build-isolation --no-deps --wheel-dir dist .
	@ls dist/*.whl

clean:
	rm -rf build dist *.egg-info snh/*.so .pytest_cache .mypy_cache .ruff_cache

$(VENV)/.requirements: tools/setup_venv.sh pyproject.toml
	@bash tools/setup_venv.sh $(VENV)
	@touch $@

build/.native: $(NATIVE_SOURCES) $(VENV)/.requirements
	@echo "== native parts, in place (the first time takes a few minutes)"
	@$(BIN)/python setup.py --quiet build_ext --inplace
	@touch $@

$(VENV)/.installed: $(VENV)/.requirements | build/.native
	@echo "== snh-slam, editable, and the packages it uses"
	@$(BIN)/pip install --quiet --no-build-isolation --editable ".[dev]"
	@touch $@
