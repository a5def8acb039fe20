# One command each: set up what is missing, then do the job.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help

help: ## Show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

# Stamped, so that set-up costs nothing once the pinned requirements are in.
$(VENV)/.installed: requirements.txt requirements-torch.txt requirements-torch-cpu.txt requirements-dev.txt pyproject.toml \
		deploy/install-torch.sh
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --require-hashes -r requirements.txt
	deploy/install-torch.sh $(BIN)/pip
	# What comes as source is built with the setuptools just installed, not with one that nobody checked.
	$(BIN)/pip install --quiet --require-hashes --no-build-isolation -r requirements-dev.txt
	$(BIN)/pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

setup: $(VENV)/.installed ## Create .venv with the pinned requirements

train: setup ## Train LIIR on 3m (ARGS="--set seed=7" adds settings)
	$(BIN)/liir train --config configs/3m.yaml $(ARGS)

test: setup browser ## Run the tests that need no containers, no root and no Prometheus
	$(BIN)/pytest $(ARGS)

# From the system where root may, else the build that playwright downloads.
browser: setup ## Install Chromium, which the tests of the replay page want
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; \
	then apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; \
	else $(BIN)/playwright install chromium; fi

fuzz: setup ## Damaged messages, 100 000 into the codec and 5 000 into a learner; 100 000 more that coverage leads to
	$(BIN)/python -m tests.security.fuzz_wire $(ARGS)
	# atheris is there for Linux on x86-64 only.
	$(BIN)/python -m tests.security.fuzz_coverage -runs=100000

# Debian's package, unpacked and not installed, since an installed one starts a server.
PROMETHEUS := $(CURDIR)/$(VENV)/prometheus
$(PROMETHEUS)/usr/bin/promtool:
	mkdir -p $(PROMETHEUS)
	-apt-get update -qq
	cd $(PROMETHEUS) && apt-get download -qq prometheus && dpkg-deb -x prometheus_*.deb .

test-monitoring: setup $(or $(shell command -v promtool),$(PROMETHEUS)/usr/bin/promtool) ## Run the tests with a real Prometheus
	PATH="$$PATH:$(PROMETHEUS)/usr/bin" $(BIN)/pytest -m prometheus $(ARGS)

test-compose: setup ## Run docker-compose.yml through deaths, stops and resumes; needs docker
	$(BIN)/pytest -m compose $(ARGS)

test-ray-submit: setup ## Run ray up, submit and down on three isolated machines; needs root, sshd, rsync and ip
	$(BIN)/pytest -m ray_submit $(ARGS)

# As root in a namespace of its own where one is not root, since the tests mount a small disk.
test-faults: setup ## Run the fault tests: a hundred faults in one training, and more
	$(if $(filter 0,$(shell id -u)),,unshare --map-root-user --mount) $(BIN)/pytest -m faults $(ARGS)

test-all: test test-monitoring test-faults fuzz test-ray-submit test-compose ## All of them, before a release

MINUTES ?= 5
soak: setup ## Train for MINUTES and say whether memory, descriptors, threads or streams grow
	$(BIN)/python -m tests.faults.soak --minutes $(MINUTES)

dashboard: setup ## Write the Grafana dashboard from its program
	$(BIN)/python deploy/grafana/dashboard.py > deploy/grafana/dashboards/liir.json

PIN := UV_CUSTOM_COMPILE_COMMAND="make requirements" $(BIN)/uv pip compile --quiet --universal \
	--python-version 3.11 --generate-hashes --no-annotate $(ARGS)
PIN_REST := $(PIN) -c requirements-torch.in --no-emit-package torch
requirements: setup ## Pin what pyproject.toml asks for, with hashes (ARGS="--upgrade" takes new versions)
	$(PIN_REST) pyproject.toml --group build --extra service --extra animation --extra export -o requirements.txt
	$(PIN_REST) --group dev -c requirements.txt -o requirements-dev.txt
	for image in actor learner node; do $(PIN_REST) pyproject.toml --group build --extra $$image -c requirements.txt \
		-o deploy/requirements-$$image.txt || exit; done
	for group in uv aws; do $(PIN_REST) --group $$group -c requirements.txt -o deploy/requirements-$$group.txt || exit; done
	# Not as pyproject.toml says that torch is: with what the usual build needs.
	$(PIN) --no-config -c requirements.txt requirements-torch.in -o requirements-torch.txt

lint: setup ## Check style, types, import rules and generated code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) proto-check

GEN := liir_common/rpc/gen

proto: setup ## Generate the gRPC code from proto/
	rm -rf $(GEN)
	mkdir -p $(GEN)
	$(BIN)/python -m grpc_tools.protoc -I proto --python_out=$(GEN) --pyi_out=$(GEN) --grpc_python_out=$(GEN) proto/liir/v1/*.proto
	# protoc knows only top-level packages; ours live inside liir_common.
	sed -i -E 's/^from liir\.v1 import/from liir_common.rpc.gen.liir.v1 import/' $$(find $(GEN) -name '*.py' -o -name '*.pyi')
	touch $(GEN)/__init__.py $(GEN)/liir/__init__.py $(GEN)/liir/v1/__init__.py

proto-check: proto
	git diff --exit-code -- $(GEN)
	test -z "$$(git ls-files --others -- $(GEN) | grep -v __pycache__)"

.PHONY: help setup train test test-all browser fuzz test-monitoring test-compose test-ray-submit test-faults soak dashboard \
	requirements lint proto proto-check
