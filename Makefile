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

.PHONY: env demo test test-full lint bench train export scenes figures-masks clean

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

test: lint
	$(BIN)/pytest -m 'not slow'

test-full: lint
	$(BIN)/pytest

bench: env
	$(BIN)/python -m tests.bench

# The network. SCENES and DATA are folders of sets in the layout that models/MODEL_CARD.md describes.
DATA ?= ../shared/data/training
SCENES ?= training/scenes
MINUTES ?= 60
MODEL_VERSION ?= 1.0

$(TRAIN)/.installed: pyproject.toml constraints.txt
	test -x $(TRAIN)/bin/python || $(PYTHON) -m venv $(TRAIN)
	$(TRAIN)/bin/python -m pip install --quiet --disable-pip-version-check 'torch==2.13.0'
	$(TRAIN)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[train]'
	touch $@

# 2 to 3 s a picture and core, 8 to 12 minutes for 400 on two idle cores; the set appears when it is whole.
scenes: env
	$(BIN)/python -m monitor.training_scenes --out $(SCENES) --count 400 --seed 1

train: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.train --data $(DATA) --data $(dir $(SCENES)) --out training/run --minutes $(MINUTES)

export: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m models.export --checkpoint training/run/checkpoint.pt --out models/bisenetv2.onnx --version $(MODEL_VERSION)

figures-masks: env
	$(BIN)/calibwatch evaluate masks $(DATA) --out $(OUT)/masks

clean:
	rm -rf $(VENV) $(TRAIN) $(OUT) build *.egg-info
