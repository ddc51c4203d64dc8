# Two commands install everything: `make demo` (for the runtime, without torch) and `make test` (all packages).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_ARGS ?=
PYTEST_ARGS ?=
TEST_WORKERS ?= logical
FUZZ_ARGS ?=
ROOM ?= frame
MUTATE_ARGS ?=
FAULT_ARGS ?=
GOLDEN_ARGS ?=
export PIP_DISABLE_PIP_VERSION_CHECK = 1

# pip names each package as it is downloaded, with a bar on a terminal.
PROGRESS := --progress-bar on
NIGHTLY := out/nightly
SANITIZED := out/sanitized
SANITIZERS := -fsanitize=address,undefined -fno-sanitize-recover=all
# GCC 12 with both sanitizers and ivopts computes wrong values, without a report; Clang and either one alone do not.
SANITIZED_FLAGS := $(SANITIZERS) -fno-ivopts -g1 -DONE_LEVEL
SANITIZE_ARGS ?=
# Tests of processes with little memory, in which the sanitizers' own does not fit.
LIMITED := --ignore tests/model/test_session.py --ignore tests/model/test_picture_networks.py -k "not too_little_memory and not inputs_of_another_version and not named_file_never and not splats"

.PHONY: demo test test-setup test-slow golden lint types secrets coverage nightly package bench fuzz mutate soak faults install uninstall system eye-models models gallery site hashes clean

demo: $(VENV)/.runtime
	$(BIN)/phasestack demo $(DEMO_ARGS)

# Only install what tests need, so that one test file can be run at once: .venv/bin/python -m pytest tests/optics
test-setup: $(VENV)/.test
	@echo "Run one file with: $(BIN)/python -m pytest tests/optics/test_malus.py"

test: $(VENV)/.test lint types
	$(BIN)/python -m pytest -m "not slow" -n $(TEST_WORKERS) --dist loadfile --max-worker-restart 0 $(PYTEST_ARGS)

test-slow: $(VENV)/.test
	@sh systemd/packages.sh slow
	$(BIN)/python -m pytest -m slow --timeout 3600 $(PYTEST_ARGS)

# Replace the golden runs' references after an intended change; GOLDEN_ARGS="walk fault": only these.
golden: $(VENV)/.test
	$(BIN)/python -m tests.golden --renew $(GOLDEN_ARGS)

# Style, layers, spelling, prose, docstrings' examples, shell. `pre-commit install` runs them, with types and secrets, before every commit.
lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/typos
	$(BIN)/python -m pytest -q --doctest-modules tests/test_prose.py runtime/errors.py runtime/support
	$(BIN)/shellcheck .ci/run systemd/*.sh requirements/*.sh docs/*.sh systemd/x-authority systemd/back-off

types: $(VENV)/.test
	$(BIN)/mypy

secrets: $(VENV)/.test
	git ls-files -z | xargs -0 $(BIN)/detect-secrets-hook --exclude-files '\.lock$$|\.npz$$'

# Branch coverage, with its minimum in pyproject.toml; takes twice as long as the tests.
coverage: $(VENV)/.test
	$(BIN)/python -m pytest -m "not slow" -n $(TEST_WORKERS) --dist loadfile --cov --cov-report=term:skip-covered --cov-report=html:out/coverage

# Checks that take too long for every change: the slow tests, coverage, every fuzzer, sanitizers, secrets in all files, other
# mutations each night, and the frontier against the night before (exit 1 if slower or worse beyond noise).
nightly: test-slow coverage fuzz sanitize secrets
	for room in frame eyes optics model panels content calib kernels; do \
	  $(BIN)/python -m tests.mutate $$room --count 20 --seed $$(date +%j) || exit 1; done
	mkdir -p $(NIGHTLY)
	$(BIN)/phasestack bench --out $(NIGHTLY)/bench-new.json
	if [ -e $(NIGHTLY)/bench.json ]; then $(BIN)/phasestack bench compare $(NIGHTLY)/bench.json $(NIGHTLY)/bench-new.json; fi
	mv $(NIGHTLY)/bench-new.json $(NIGHTLY)/bench.json

# Wheel and sdist in dist/; tests/test_packages.py (slow) installs them into an empty environment and runs the demo.
package: $(VENV)/.test
	$(BIN)/python -m build --outdir dist

bench: $(VENV)/.test
	$(BIN)/phasestack bench --out out/bench.json

# Examples that no run before has tried.
nightly coverage fuzz: export HYPOTHESIS_PROFILE = new

# Every reader of untrusted bytes, some thousand bad files each; FUZZ_ARGS="-k gltf" for one of them.
fuzz: $(VENV)/.test
	FUZZ_EXAMPLES=$${FUZZ_EXAMPLES:-10000} $(BIN)/python -m pytest tests/fuzz -n $(TEST_WORKERS) --timeout 3600 $(FUZZ_ARGS)

# Change one place of a room at a time, and count the changes that its tests notice; MUTATE_ARGS="--count 100 --seed 7".
mutate: $(VENV)/.test
	$(BIN)/python -m tests.mutate $(ROOM) $(MUTATE_ARGS)

# The kernels with AddressSanitizer and UndefinedBehaviorSanitizer, built in a copy of the sources: their tests, those of
# what calls them, and random geometry. FUZZ_EXAMPLES=100000: a night of it; SANITIZE_ARGS="-k fuzz": only some tests.
sanitize: $(VENV)/.test
	rm -rf $(SANITIZED) && mkdir -p $(SANITIZED)
	git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents -t $(SANITIZED)
	cd $(SANITIZED) && CFLAGS="$(SANITIZED_FLAGS)" CXXFLAGS="$(SANITIZED_FLAGS)" LDFLAGS="$(SANITIZERS)" \
	$(CURDIR)/$(BIN)/python -c "from setuptools import setup; setup()" -q build_ext --inplace
	grep -q __asan_report_load $(SANITIZED)/runtime/kernels/compiled*.so && grep -q __ubsan_handle $(SANITIZED)/runtime/kernels/compiled*.so
	cd $(SANITIZED) && LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libstdc++.so)" \
	ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1 FUZZ_EXAMPLES=$${FUZZ_EXAMPLES:-2000} \
	$(CURDIR)/$(BIN)/python -m pytest tests/fuzz/test_kernels.py tests/model tests/panels tests/optics -m "not slow" $(LIMITED) -n $(TEST_WORKERS) --timeout 3600 $(SANITIZE_ARGS)

soak: $(VENV)/.test
	$(BIN)/python -m tests.soak

# Each fault of a solver or a sensor ten times while a viewer walks, and what it costs; FAULT_ARGS="--tries 3".
faults: $(VENV)/.test
	$(BIN)/python -m tests.faults $(FAULT_ARGS)

install: system
	sh systemd/install.sh

uninstall:
	sh systemd/uninstall.sh

# Rebuild the eye networks from their publishers' files, next to the shipped ones.
eye-models:
	sh docs/make_eye_models.sh out/eye-models

# Rebuild the shipped models from their recipes; the pinned torch and onnx give the same bytes.
models: $(VENV)/.test
	for name in fast balanced best; do $(BIN)/phasestack export --arch $$name --out runtime/model/data/$$name.onnx || exit 1; done
	cd runtime/model/data && sha256sum balanced.onnx best.onnx fast.onnx > SHA256SUMS

# The pages and the API's reference as a site in out/site; docs/make_figures.py draws its diagrams.
site: $(VENV)/.docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html -c docs/site . out/site
	@echo "open out/site/docs/index.html"

# docs/performance.md and the pages' pictures from the commands (minutes).
gallery: $(VENV)/.test
	$(BIN)/python -m docs.make_gallery

# Rewrite the locks' hashes for their pins, from the registry.
hashes:
	sh requirements/make_hashes.sh

# Debian's packages: g++, OpenGL without a screen, the USB and OpenNI2 libraries. Only root can install them.
system:
	@sh systemd/packages.sh

$(VENV)/.created:
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.runtime: $(VENV)/.created requirements/runtime.lock pyproject.toml $(wildcard runtime/kernels/*.?pp) | system
	@echo "1 of 2: downloading and installing $$(grep -c == requirements/runtime.lock) packages in $(VENV) (minutes on a slow line)"
	$(BIN)/python -m pip install $(PROGRESS) -r requirements/runtime.lock
	@echo "2 of 2: compiling the kernels (two minutes on a slow machine)"
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	@touch $@

$(VENV)/.test: $(VENV)/.runtime requirements/test.lock requirements/torch.lock
	@sh systemd/packages.sh test
	@echo "1 of 2: downloading and installing $$(grep -c == requirements/test.lock) packages for tests"
	$(BIN)/python -m pip install $(PROGRESS) -r requirements/test.lock
	@echo "2 of 2: downloading and installing torch for the CPU (200 MB)"
	$(BIN)/python -m pip install $(PROGRESS) -r requirements/torch.lock
	@touch $@

$(VENV)/.docs: $(VENV)/.test requirements/docs.lock
	$(BIN)/python -m pip install --quiet --no-deps -r requirements/docs.lock
	@touch $@

clean:
	rm -rf $(VENV) build dist out *.egg-info runtime/kernels/*.so .mypy_cache .ruff_cache .pytest_cache
