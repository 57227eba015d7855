# Everything happens in .venv; each target makes what it needs, so that one command is enough on a fresh machine.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TRAIN := .venv-train
OUT ?= out

# The matrices are small: threads of BLAS cost time and gain none. onnxruntime has its own.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 2

.PHONY: env demo test test-full lint bench train export scenes figures-masks figures-plk figures-crlf figures-drift clean

env: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: env
	$(BIN)/calibwatch demo --out $(OUT)/demo

lint: env
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

# SEED fixes the order and the random examples, where a verdict must not depend on chance.
test: lint
	$(BIN)/pytest -m 'not slow' $(if $(SEED),--randomly-seed=$(SEED))

test-full: lint
	$(BIN)/pytest

bench: env
	$(BIN)/python -m tests.bench

# The networks. SCENES and DATA are folders of sets in the layout that models/MODEL_CARD.md describes.
DATA ?= ../shared/data/training
SCENES ?= training/scenes
MINUTES ?= 110
MODEL_VERSION ?= 2.0
# How often each set is drawn: what shows paint or poles of a real camera often, what is one scene seldom.
# Sets that are not named count by the root of their size.
SHARES ?= $(foreach s,camvid32=3 kitti_sem=3.5 dashcam_roadmark=2.5 ego_lane_video=1.2 bdd_sem=1.5 \
	comma10k_mini=1 camvid11=1.3 carla_town04=0.2 scenes=6,\
	$(if $(or $(wildcard $(DATA)/$(firstword $(subst =, ,$(s)))),$(filter scenes=%,$(s))),--weight $(s)))
# Pictures of our own, or under MIT or CC BY with nothing else in the way: the card says why for each.
FREE_SETS ?= dashcam_roadmark comma10k_mini carla_town04 scenes
FREE_SHARES ?= --weight dashcam_roadmark=3 --weight comma10k_mini=1.3 --weight carla_town04=0.3 --weight scenes=10

$(TRAIN)/.installed: pyproject.toml constraints.txt
	test -x $(TRAIN)/bin/python || $(PYTHON) -m venv $(TRAIN)
	$(TRAIN)/bin/python -m pip install --quiet --disable-pip-version-check 'torch==2.13.0'
	$(TRAIN)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[train]'
	touch $@

# 2 to 3 s a picture and core, 12 to 16 minutes for 550 on two idle cores; the set appears when it is whole.
scenes: env
	$(BIN)/python -m monitor.training_scenes --out $(SCENES) --count 550 --seed 1

train: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.train --data $(DATA) --data $(dir $(SCENES)) $(SHARES) --out training/run --minutes $(MINUTES)

train-free: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.train --data $(DATA) --data $(dir $(SCENES)) $(addprefix --set ,$(FREE_SETS)) $(FREE_SHARES) \
		--out training/run_free --minutes $(MINUTES)

export: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.export --checkpoint training/run/checkpoint.pt --out models/bisenetv2.onnx --version $(MODEL_VERSION)

export-free: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.export --checkpoint training/run_free/checkpoint.pt --out models/bisenetv2_free.onnx \
		--version $(MODEL_VERSION)-free

figures-masks: env
	$(BIN)/calibwatch evaluate masks $(DATA) --out $(OUT)/masks

figures-plk: env
	$(BIN)/calibwatch evaluate plk-table1 --out $(OUT)/plk
	$(BIN)/calibwatch evaluate plk-fig5 --out $(OUT)/plk
	$(BIN)/calibwatch evaluate plk-fig6 --out $(OUT)/plk

# Recorded frames are read where they are; the rest is simulated. Some 25 minutes of an idle core.
CALIBWATCH_DATA ?= ../shared/data
# Whose publishers' extrinsic is known to be worse than the others'.
KNOWN ?= $(foreach s,nuscenes_mmdet3d=0.5=0.05 rellis_os1=0.5=0.1 opencalib_st1=0.3=0.05 opencalib_st2=0.3=0.05,\
	$(if $(wildcard $(CALIBWATCH_DATA)/$(firstword $(subst =, ,$(s)))),--set-sigma $(subst =, ,$(s))))
figures-crlf: env
	rm -rf $(OUT)/crlf
	$(BIN)/calibwatch evaluate dataset --simulated 30 --starts 1 --out $(OUT)/crlf/near
	$(BIN)/calibwatch evaluate dataset --simulated 30 --starts 1 --rotation 6 --translation 1 --prior-sigma 3 0.5 \
		--out $(OUT)/crlf/far
	$(if $(wildcard $(CALIBWATCH_DATA)),$(BIN)/calibwatch evaluate dataset $(CALIBWATCH_DATA) $(KNOWN) --out $(OUT)/crlf/recorded)
	$(BIN)/calibwatch evaluate basin --simulated 4 --out $(OUT)/crlf/basin
	$(BIN)/python docs/crlf_page.py $(OUT)/crlf docs

# Runs that were finished stand in $(OUT)/drift and are not run again: remove it after a change of the watch.
# Some hours of an idle core: ten seconds a run.
DRIVES ?= $(wildcard $(addprefix $(CALIBWATCH_DATA)/,kitti_raw_0009_a kitti_raw_sfnd kitti_raw_0005_a kitti_odom_03_a))
figures-drift: env
	$(BIN)/calibwatch evaluate drift --simulated 4 --runs 6 --out $(OUT)/drift/simulated
	$(if $(DRIVES),$(BIN)/calibwatch evaluate drift $(DRIVES) --baseline other --limits 0.5 0.1 \
		--kinds healthy,combined,single,compensating,ramp,vibration,time-offset,focal,offline --out $(OUT)/drift/limits)
	$(if $(DRIVES),$(BIN)/calibwatch evaluate drift $(DRIVES) --baseline other --kinds healthy,combined --out $(OUT)/drift/usual)
	$(if $(DRIVES),$(BIN)/calibwatch evaluate drift $(DRIVES) --limits 0.5 0.1 --kinds healthy,combined,single,slip \
		--out $(OUT)/drift/alone)
	$(BIN)/python docs/drift_page.py $(OUT)/drift docs

clean:
	rm -rf $(VENV) $(TRAIN) $(OUT) build *.egg-info
