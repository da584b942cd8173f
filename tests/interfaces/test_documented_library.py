"""The Python library, as docs/interfaces.md lists it."""

from __future__ import annotations

import dataclasses
import inspect
import json
from pathlib import Path

import numpy as np

import ultragray
from ultragray import (
    GaussianScene,
    LinearProbe,
    PhasedProbe,
    Probe,
    confidence,
    contract,
    demo,
    errors,
    pose,
    rendering,
    samplers,
)
from ultragray.datasets import Dataset, Sweep, checks, dicom, phantom, pictures, plus, released, source
from ultragray.display import frames as display_frames
from ultragray.display import scan_conversion
from ultragray.display import settings as display
from ultragray.evaluation import baselines, compounding, metrics, side_by_side, speckle
from ultragray.evaluation import scoring as evaluation
from ultragray.files import atomic as files
from ultragray.files import poses as pose_file
from ultragray.interchange import checkpoint, checkpoint_export, exports, ply
from ultragray.interchange import rendering as file_rendering
from ultragray.interchange.exports import png_folder

from .document import call_of, code, table

LIBRARY_MODULES = (
    checkpoint,
    checkpoint_export,
    demo,
    display,
    display_frames,
    file_rendering,
    files,
    ply,
    pose,
    pose_file,
    rendering,
    scan_conversion,
)
MEASURING_MODULES = (baselines, compounding, evaluation, metrics, side_by_side, speckle, png_folder)
MEMBERS_OF = (GaussianScene, Probe, errors.UltragrayError)


def test_library() -> None:
    calls = {name: getattr(ultragray, name) for name in ultragray.__all__}
    assert set(table("Python library")) == {
        call_of(value) if hasattr(value, "__name__") and callable(value) else name for name, value in calls.items()
    }


def test_members() -> None:
    public = {
        f"{cls.__name__}.{name}"
        for cls in MEMBERS_OF
        for name in set(dir(cls)) - set(dir(Exception)) - set(inspect.signature(cls).parameters)
        if not name.startswith("_")
    }
    assert set(table("Members")) == public


def test_other_modules() -> None:
    found = {
        f"{module.__name__}.{call_of(value)}"
        for module in (*LIBRARY_MODULES, *MEASURING_MODULES, checks, dicom, pictures, released, source)
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__
        if not name.startswith("_") and name not in ultragray.__all__
    }
    found |= {
        f"{phantom.__name__}.{call_of(value)}"
        for value in (getattr(phantom, name) for name in phantom.__all__)
        if inspect.isfunction(value)
    }
    found |= {
        f"{package.__name__}.{call_of(value)}"
        for package in (samplers, exports, plus)
        for value in (getattr(package, name) for name in package.__all__)
        if inspect.isfunction(value)
    }
    found |= {
        f"{confidence.__name__}.{call_of(value)}"
        for value in (getattr(confidence, name) for name in confidence.__all__)
        if callable(value)
    }
    found |= {f"{contract.__name__}.{call_of(function)}" for function in (contract.from_dict, contract.to_dict)}
    assert set(table("Other modules")) == found


def test_samplers() -> None:
    documented = {}
    for kind, (keys, _) in table("Samplers").items():
        parts = [code(part) for part in keys.split(",")] if keys else []
        documented[kind] = {name: json.loads(default[0]) if default else "required" for name, *default in parts}
    assert documented == {
        kind: {
            item.name: "required" if item.default is dataclasses.MISSING else item.default
            for item in dataclasses.fields(cls)
            if item.name != "kind"
        }
        for kind, cls in samplers.Sampler.members.items()
    }


def test_export_formats() -> None:
    documented = {
        name: (code(suffix)[0], tuple(code(pixels)), (code(extra) or [None])[0])
        for name, (suffix, pixels, extra, _) in table("Export formats").items()
    }
    assert documented == {name: (one.suffix, one.dtypes, one.extra) for name, one in exports.FORMATS.items()}


def test_dataset_configuration(tmp_path: Path) -> None:
    images = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    found: set[str] = set()
    for number, one in enumerate((LinearProbe(40, 0, 50), PhasedProbe(60, 50))):
        sweep = Sweep(images, np.tile(np.eye(4), (2, 1, 1)), one, np.arange(2), "here")
        released.write_released(Dataset("name", sweep, sweep), tmp_path / str(number))
        found |= set(json.loads((tmp_path / str(number) / "conf.json").read_text()))
    assert set(table("Dataset configuration")) == {key for key in found if not key.startswith("_")}
