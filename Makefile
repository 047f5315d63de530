# `make` prints the targets. Each makes its own virtual environment in .venv first; PYTHON names the interpreter for it.

PYTHON ?= python3
SYSTEM ?= debian12
ARCH ?= arm64
VENV := .venv
BIN := $(VENV)/bin
BUILDER ?= $(shell command -v podman || echo docker)
# ROS 2's wheels start each Python twice, to name their libraries to the loader: an environment of their own.
ROS_VENV := .venv-ros
LOCK := requirements/service.txt
# Only wheels: the code of a source package would run while it is installed.
COMPILE = $(BIN)/uv pip compile --quiet --no-header --no-annotate --only-binary=:all: pyproject.toml -

.DEFAULT_GOAL := help
.PHONY: help demo live docs lint test quick test-all browser training coverage ros faults flights breakages mutants references wheel release deb container install-emulated lock sbom clean

help:
	@sed -n 's/^\([a-z-]*\):.* ## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20
	@echo 'For who changes flockd:'
	@sed -n 's/^\([a-z-]*\):.* ### /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20

demo: $(VENV)/sim.installed ## fly the paper's flight in the simulator and write its report
	$(BIN)/flockd sim

live: $(VENV)/sim.installed $(VENV)/fleet.installed ## fly a simulated flock by sight on a page in the browser, until Ctrl-C; EXACT=1: on exact states
	$(BIN)/flockd sim --live $(if $(EXACT),--perception truth)

docs: $(VENV)/docs.installed ## build the documentation as a site in out/site
	$(BIN)/python -m tools.docs.docs_reference
	$(BIN)/mkdocs build --strict

lint: $(VENV)/test.installed ### ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(VENV)/test.installed ## lint and all tests but the slow ones, side by side, on two cores in under 10 minutes
	$(MAKE) --jobs=2 lint quick

# Three on two cores: many wait for sleeps and sockets.
quick: $(VENV)/test.installed
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "not slow and not browser and not ros and not training" --durations=10 --durations-min=1

test-all: lint ### lint and all tests, those too that take minutes each
	$(BIN)/python -m pytest -n 2

ros: $(ROS_VENV)/ros.installed ### what needs ROS 2: nodes in processes of their own, cameras by topic; with the times it takes
	$(ROS_VENV)/bin/python -m pytest -m ros -rP tests/fleet/ros tests/tools/release/test_licences.py

faults: $(VENV)/test.installed ### the slow stories of faults of a whole drone, and 20 s of flight from pixels; in about 10 minutes
	$(BIN)/python -m pytest -n 2 -m "slow and fault and not whole_flight and not browser and not ros" --durations=10
	$(BIN)/python -m pytest -m slow tests/sim/flock/test_swarm.py -k twenty_seconds_from_pixels

flights: $(VENV)/test.installed ### flights of minutes: encounters, two daemons, PX4's test card; in about half an hour
	$(BIN)/python -m pytest -n 2 -m "slow and whole_flight and not browser and not ros" --durations=10

training: $(VENV)/test.installed $(VENV)/train.installed ### the tests of the networks' training, with torch (0.9 GB; with CUDA several)
	$(BIN)/python -m pytest -m training tests/tools/training

browser: $(VENV)/test.installed $(VENV)/browser.installed ### the fleet page in a headless Chromium: /usr/bin/chromium, or what CHROMIUM names
	$(BIN)/python -m pytest -m browser -rP tests/fleet/page

coverage: $(VENV)/test.installed ### which branches of the safety layer its tests take; fails below all of them
	$(BIN)/python -m coverage run --branch --source=flockd/flight/safety -m pytest tests/flight/safety
	$(BIN)/python -m coverage report --show-missing --fail-under=100

breakages: $(VENV)/test.installed ### break flockd on purpose in some eighty places, and see that a test notices each, in about 3 minutes
	$(BIN)/python -m tools.checks.breakages

MUTANTS ?= 0
mutants: $(VENV)/test.installed ### the same with every small change of the safety layer, in about a quarter of an hour; MUTANTS=60: some
	$(BIN)/python -m tools.checks.breakages --mutants $(MUTANTS)

references: $(VENV)/test.installed ### write what the recorded flights of tests/review/replay are expected to give again
	$(BIN)/python -m tools.checks.references

wheel: $(VENV)/test.installed ### build sdist and wheel in dist, check them, install the wheel alone, and fly it
	$(BIN)/python -m tools.release.check_wheel --out dist

release: wheel ### that; then sbom, deb and container
	$(MAKE) sbom deb container

deb: $(BIN)/pip ### build Debian packages for amd64 and arm64 in dist; SYSTEM=debian13 or ubuntu24.04 for others than Debian 12
	$(BIN)/python -m tools.release.deb --arch amd64 --system $(SYSTEM) --out dist
	$(BIN)/python -m tools.release.deb --arch arm64 --system $(SYSTEM) --out dist

container: ### build the container with podman or docker, and replay a flight in it; BASE=IMAGE for another Debian 12
	$(BUILDER) build $(if $(BASE),--build-arg BASE=$(BASE)) --tag localhost/flockd .
	$(BUILDER) run --rm localhost/flockd models verify
	$(BUILDER) run --rm --volume ./tests/review/replay/normal.mcap:/tmp/flight.mcap:ro localhost/flockd \
		replay /tmp/flight.mcap --out /tmp/replayed

install-emulated: $(VENV)/test.installed ### as root: install the arm64 package in a new system under emulation, and fly it; SYSTEM=debian13, ARCH=, MIRROR=URL
	$(BIN)/python -m tools.release.check_emulated --system $(SYSTEM) --arch $(ARCH) $(if $(MIRROR),--mirror $(MIRROR))

lock: $(VENV)/release.installed ### write requirements/service.txt again, with the newest versions that pyproject.toml permits
	echo setuptools | $(COMPILE) --universal --fork-strategy=fewest --python-version=3.11 --generate-hashes \
		--emit-build-options --upgrade --output-file=$(LOCK).new
	for system in x86_64 aarch64; do for python in 3.11 3.12 3.13; do echo setuptools | $(COMPILE) \
		--constraint=$(LOCK).new --python-platform=$$system-unknown-linux-gnu --python-version=$$python > /dev/null || exit 1; \
		done; done
	(sed '/^#/!d' $(LOCK); cat $(LOCK).new) > $(LOCK).whole && mv $(LOCK).whole $(LOCK) && rm $(LOCK).new

sbom: $(VENV)/release.installed $(VENV)/test.installed ### check licences, and write the software bill of materials to out/flockd.cdx.json
	rm -rf $(VENV)/service && mkdir -p out
	$(BIN)/uv venv --quiet $(VENV)/service
	$(BIN)/uv pip install --quiet --python $(VENV)/service --require-hashes -r $(LOCK)
	$(BIN)/python -m tools.release.licences $(VENV)/service/bin/python
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o out/flockd.cdx.json $(VENV)/service

clean: ### delete the virtual environment and what was built
	rm -rf $(VENV) $(ROS_VENV) build dist *.egg-info

# The extra of this name, installed; again only when what it installs has changed.
$(VENV)/%.installed: pyproject.toml setup.py | $(BIN)/pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@

$(ROS_VENV)/ros.installed: pyproject.toml setup.py
	$(PYTHON) -m venv $(ROS_VENV)
	$(ROS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[ros,bags,sim,fleet]' \
		'pytest>=8' 'packaging>=24' 'hypothesis>=6.150'
	touch $@

$(BIN)/pip:
	$(PYTHON) -m venv $(VENV)
