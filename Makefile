# Every target sets itself up: a fresh clone needs Python 3.11-3.14, make and a package registry, nothing else.
.DEFAULT_GOAL := help
.PHONY: help install demo browser emulator hosts-tools api test test-bare test-deploy test-nightly check format audit bench soak scale faults hostile instructions schema clean
.DELETE_ON_ERROR:

PYTHON ?=
RIG ?= desk
DEMO_SECONDS ?= 30
DEMO_ARGS ?=
TEST_ARGS ?=
BARE_ARGS ?=
BENCH_ARGS ?=
SOAK_ARGS ?=
SCALE_ARGS ?=
AUDIT_ARGS ?=
FAULTS_ARGS ?=
HOSTILE_ARGS ?=
INSTRUCTIONS_ARGS ?=

# Tests and demo start a hundred processes: each would compile all modules anew where their bytecode is not kept.
unexport PYTHONDONTWRITEBYTECODE

BIN := .venv/bin
STAMP := .venv/.installed
# The default rig of a scene is not named, so that DEMO_ARGS may name a scene or a rig of its own.
DEMO_RIG := $(filter-out desk,$(RIG))
DEMO_OUT := out/demo$(addprefix -,$(DEMO_RIG))
# Fits: 3.11-3.14, and able to make a virtual environment (Debian splits ensurepip off into python3-venv).
FITS := import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | while IFS="$$(printf '\t')" read -r target text; do printf '  make %-12s %s\n' "$$target" "$$text"; done
	@echo "  variables: PYTHON=python3.12  RIG=desk-fabrik  DEMO_SECONDS=30  DEMO_ARGS='--headless'  TEST_ARGS='-k geometry'  BENCH_ARGS=..."

install: $(STAMP) ## make .venv with everything in it, in the locked versions
	@echo "ready: $(BIN)/phalanx --help"

demo: $(STAMP) ## two simulated cameras and the master as live processes on this machine; RIG=desk-fabrik for the other solver
	@mkdir -p $(DEMO_OUT)
	@headless=; [ -n "$${DISPLAY-}$${WAYLAND_DISPLAY-}" ] || headless=--headless; \
	  exec $(BIN)/phalanx demo $$headless $(addprefix --rig ,$(DEMO_RIG)) --seconds $(DEMO_SECONDS) \
	    --out $(DEMO_OUT) --json $(DEMO_OUT)/summary.json $(DEMO_ARGS)

browser: ## a Chromium for the tests of the console's pages; without root it says what to install
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing Chromium for the tests of the console ..."; \
	    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core; } >/dev/null 2>&1 \
	      || echo "Chromium could not be installed: the tests of the console's pages are skipped"; \
	  else echo "no Chromium: the tests of the console's pages are skipped (Debian: apt install chromium)"; fi; }

api: $(STAMP) ## the reference of the API from the docstrings, as pages below out/api
	@$(BIN)/pdoc -o out/api -d google common slave master deploy && echo "open out/api/index.html"

# $(call apt,what for,packages,a command that one of them brings): as root of a Debian; elsewhere it says what is left out.
define apt
	@missing=; for tool in $(3); do command -v "$$tool" >/dev/null || missing="$$missing $$tool"; done; \
	  if [ -n "$$missing" ]; then \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    echo "installing for $(1): $(2) ..."; \
	    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(2); } >/dev/null 2>&1 \
	      || echo "could not be installed: $(1) will be skipped"; \
	  else echo "missing:$$missing; $(1) will be skipped (Debian: apt install $(2))"; fi; fi
endef

emulator: ## what checks the service and runs aarch64 programs in the tests; without root it says what to install
	$(call apt,the tests of the service and on aarch64,systemd mmdebstrap gcc libc6-dev debian-archive-keyring,systemd-analyze mmdebstrap gcc)

hosts-tools: emulator ## what the tests with whole machines need; without root it says what to install
	$(call apt,the tests with whole machines,qemu-system-arm qemu-system-x86 qemu-utils systemd-container rsync openssh-client iproute2 tcpdump kmod,qemu-system-aarch64 qemu-system-x86_64 systemd-nspawn rsync ssh ip tcpdump depmod)

# A test that hangs says where each thread stands and takes its worker with it; another worker goes on.
HANG := -o faulthandler_timeout=400 -o faulthandler_exit_on_timeout=true

test: check browser emulator ## check, then all tests; one that fails or hangs is tried once more, and listed
	@$(BIN)/python -m pytest -n 3 --reruns 1 --dist loadfile --no-loadscope-reorder $(HANG) $(TEST_ARGS)

test-bare: ## the gate on a Debian that has git, make and python3-venv alone, and is thrown away; as root, 30 min
	$(call apt,the gate on a bare Debian,mmdebstrap debian-archive-keyring,mmdebstrap)
	@mkdir -p out && git bundle create --quiet out/head.bundle HEAD
	@! command -v mmdebstrap >/dev/null || mmdebstrap --quiet --variant=apt --include=ca-certificates,git,make,python3-venv \
	  --customize-hook='upload out/head.bundle /head.bundle' $(BARE_ARGS) \
	  --customize-hook='chroot "$$1" sh -c "git clone -q -c advice.detachedHead=false /head.bundle /root/phalanx && exec env -u MAKEFLAGS -u MAKELEVEL /root/phalanx/.ci/run"' bookworm /dev/null

test-deploy: $(STAMP) hosts-tools ## deploy by ssh to two small machines and an emulated arm64 board; as root, 15 min
	@$(BIN)/python -m pytest tests/hosts $(TEST_ARGS)

test-nightly: $(STAMP) hosts-tools ## cameras, I2C and a bad network through the kernel's own drivers, in emulation; as root, 20 min
	@$(BIN)/python -m pytest tests/nightly $(TEST_ARGS)

check: $(STAMP) ## lint, format and strict types
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/python -m pyright --threads 2 --pythonpath $(BIN)/python

format: $(STAMP) ## rewrite the layout of all files, and mend what lint can mend
	@$(BIN)/ruff check --fix --quiet || true
	@$(BIN)/ruff format

bench: $(STAMP) ## the table of performance, each row against a baseline of the same run
	@$(BIN)/python -m bench $(BENCH_ARGS)

soak: $(STAMP) ## an hour with both sensors: memory, latency, loss; SOAK_ARGS='--minutes 5' for less
	@$(BIN)/python -m bench soak $(SOAK_ARGS)

scale: $(STAMP) ## what 2 to 16 simulated cameras cost, what is lost, how late poses are; into docs/scale.html
	@$(BIN)/python -m bench scale --page docs/scale.html $(SCALE_ARGS)

faults: $(STAMP) ## every fault on real processes: what is expected, what is measured; FAULTS_ARGS='--runs 1'
	@$(BIN)/python -m tests.faults.links $(FAULTS_ARGS)

hostile: $(STAMP) ## stolen devices say what they like to a running master; HOSTILE_ARGS='--messages 20000' for less
	@$(BIN)/python -m tests.faults.hostile $(HOSTILE_ARGS)

audit: $(STAMP) ## known vulnerabilities of all that is locked; AUDIT_ARGS='-f cyclonedx-json -o sbom.json' writes what is in it
	@$(BIN)/python -m pip_audit -r constraints.txt --disable-pip --no-deps --strict --progress-spinner off $(AUDIT_ARGS)

instructions: $(STAMP) ## aarch64 instructions of the slave per frame, against the record; INSTRUCTIONS_ARGS=six for one case
	@$(BIN)/python -m tests.aarch64.instructions $(INSTRUCTIONS_ARGS)

schema: $(STAMP) ## write docs/schema/*.json afresh from the types
	@$(BIN)/python -m tests.test_schemas

clean: ## remove .venv, out/ and caches
	rm -rf .venv out .pytest_cache .ruff_cache .hypothesis

# A virtual environment moved or half made is worse than none: any change of the inputs makes it afresh.
$(STAMP): pyproject.toml constraints.txt
	@set -eu; found=; \
	for python in $(if $(PYTHON),"$(PYTHON)",python3 python3.14 python3.13 python3.12 python3.11); do \
	  if "$$python" -c '$(FITS)' >/dev/null 2>&1; then found="$$python"; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "make: no fitting Python$(if $(PYTHON), in PYTHON=$(PYTHON)): Phalanx needs 3.11 to 3.14 with venv (Debian, Ubuntu: apt install python3-venv);" >&2; \
	  echo "      name one: make install PYTHON=/path/to/python3.12" >&2; exit 1; \
	fi; \
	echo "installing into .venv with $$("$$found" -V) ..."; \
	rm -rf .venv; \
	if command -v uv >/dev/null 2>&1; then \
	  uv venv --quiet --python "$$found" .venv; pip="uv pip install --quiet --python $(BIN)/python"; \
	else \
	  "$$found" -m venv .venv; pip="$(BIN)/python -m pip install --quiet --disable-pip-version-check"; \
	fi; \
	$$pip -c constraints.txt hatchling; \
	$$pip -c constraints.txt --no-build-isolation -e '.[master,dev]'; \
	find common slave master -name '*.nb[ci]' -delete; \
	$(BIN)/python -m master.fabrik
	@touch $@
