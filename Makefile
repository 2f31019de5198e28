# Every task of the project. `make demo` and `make test` set up what they need in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

KERNEL_TESTS := $(addprefix stereokit/test_, sgm dt costs wta postprocess simd properties search) refiners/test_evidence

define MATCH_A_PAIR
import sys, cv2, numpy as np, stereokit
from importlib.metadata import metadata
left = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 96), dtype=np.uint8), (0, 0), 1)
right = np.roll(left, -5, axis=1)
assert abs(np.median(stereokit.match(left, right, max_disparity=16)) - 5) < 0.1
refined = stereokit.match(left, right, max_disparity=16, scale=0.5, refiner="stereokit")
assert abs(np.median(refined) - 5) < 0.2 and "openvino" not in sys.modules and "torch" not in sys.modules
assert metadata("stereokit")["License-Expression"] == "MIT"
cv2.imwrite("left.png", left), cv2.imwrite("right.png", right)
print("the wheel works alone:", stereokit.__file__, metadata("stereokit")["License-Expression"])
endef
export MATCH_A_PAIR

.PHONY: demo docs test checked fuzz lint types package check clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.user: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable ".[refiners,scenes]"
	@touch $@

$(VENV)/.dev: pyproject.toml refiners/kitti/pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]" --editable refiners/kitti
	@touch $@ $(VENV)/.user

demo: $(VENV)/.user  ## match a synthetic street with S1 to S4: pictures in demo/ and a table
	$(BIN)/stereokit demo --output demo

test: $(VENV)/.dev  ## all tests, two files at a time
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

checked: $(VENV)/.dev  ## tests that drive the CPU's kernels, in a build that checks every access to an array
	STEREOKIT_CHECKED=1 $(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(KERNEL_TESTS:%=tests/%.py)

fuzz: $(VENV)/.dev  ## generated calls and mutated files, ten minutes; FUZZ="--seed 2 --minutes 1" for others
	cd tests && ../$(BIN)/python -m fuzz $(FUZZ)

docs: $(VENV)/.dev  ## the documentation, in docs/_build/html; warnings are errors
	NUMBA_CACHE_DIR=$(CURDIR)/.numba_cache $(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs docs/_build/html
	@echo "open docs/_build/html/index.html"

lint: $(VENV)/.dev  ## style and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.dev  ## the strict type checker
	$(BIN)/mypy

package: $(VENV)/.dev  ## wheels and sdists; the main wheel alone, in an empty environment, matches and refines a pair
	rm -rf dist build/package
	$(BIN)/python -m hatchling build
	cd refiners/kitti && ../../$(BIN)/python -m hatchling build -d ../../dist
	$(PYTHON) -m venv build/package
	build/package/bin/pip install --quiet --disable-pip-version-check dist/stereokit-*.whl
	cd build/package && bin/python -c "$$MATCH_A_PAIR" && bin/stereokit match left.png right.png -o map.pfm --max-disparity 16

check: lint types test checked docs package  ## what CI runs

clean:  ## remove what the tasks made
	rm -rf $(VENV) .numba_cache .pytest_cache .mypy_cache .ruff_cache .import_linter_cache build dist demo study docs/_build docs/_generated
