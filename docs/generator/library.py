"""Parts about what the library defines: outputs, formats, samplers, settings, the metadata of a scene."""

from __future__ import annotations

import json
from dataclasses import MISSING, Field
from typing import Any

from ultragray.contract import annotated_fields, limits_in_words, to_dict
from ultragray.exchange.exports import FORMATS
from ultragray.learn.training.config import PRESETS, TrainingConfig
from ultragray.rendering.outputs import OUTPUTS
from ultragray.samplers import Sampler
from ultragray.scene.confidence import FIGURES
from ultragray_studies.methods.registry import METHODS

from .markdown import code, codes, in_line, summary, table


def outputs() -> str:
    rows = ((code(one.name), in_line(one.meaning), one.range_in_words) for one in OUTPUTS.values())
    return table(("Output", "Meaning", "Pixels"), rows)


def formats() -> str:
    rows = (
        (
            code(one.name),
            code(one.suffix),
            codes(one.dtypes),
            code(one.extra) if one.extra else "",
            in_line(one.meaning),
        )
        for one in FORMATS.values()
    )
    return table(("Format", "Suffix", "Pixels, the default first", "Extra", "Holds"), rows)


def npz() -> str:
    frames = [(code(one.name), code(one.dtype.name), "`[C, H, W]`", "If requested") for one in OUTPUTS.values()]
    figures = [(code(name), "`float32`", "`[C]`", "Confidence figure; NaN if unknown") for name in FIGURES]
    rows = [
        *frames,
        ("`poses`", "`float64`", "`[C, 4, 4]`", "Poses as used, mm"),
        *figures,
        ("`scene`", "`str`", "`[]`", "Name of the scene"),
        ("`scene_sha256`", "`str`", "`[]`", "SHA-256 of the scene file"),
        ("`renderer`", "`str`", "`[]`", "Name, version and backend, such as `ultragray/0.1.0 cpu-avx512`"),
    ]
    return table(("Key", "Type", "Shape", "Meaning"), rows)


def samplers() -> str:
    rows = []
    for kind, cls in Sampler.members.items():
        keys = (
            code(item.name) if item.default is MISSING else f"{code(item.name)} {code(default_of(item))}"
            for item, _ in annotated_fields(cls)
            if item.name != "kind"
        )
        rows.append((code(kind), ", ".join(keys), summary(cls)))
    return table(("Kind", "Keys with their defaults", "Poses"), rows)


def methods() -> str:
    """A section for each method, as it describes itself."""
    sections = []
    for name, method in METHODS.items():
        told = method.describe()
        recipe = "" if told.published_steps is None else f" Author's recipe: {told.published_steps:,} steps."
        sections += [f"### {told.title}: {code(name)}", "", f"{told.summary} Source: {told.source}.{recipe}", ""]
        if told.equations:
            sections += ["```text", *told.equations, "```", ""]
        sections += [*(f"- {choice}" for choice in told.choices), ""]
    return "\n".join(sections).rstrip()


def training_settings() -> str:
    presets = {name: TrainingConfig.preset(name).to_dict() for name in PRESETS}
    rows = (
        (
            code(item.name),
            *(code(_short(settings[item.name])) for settings in presets.values()),
            described(item),
        )
        for item, _ in annotated_fields(TrainingConfig)
    )
    return table(("Setting", *map(code, presets), "Meaning"), rows)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)


def keys(cls: type[Any], head: str = "Key") -> str:
    """The fields of a class of the contract, with their defaults."""
    rows = ((code(item.name), code(default_of(item)), described(item)) for item, _ in annotated_fields(cls))
    return table((head, "Default", "Meaning"), rows)


def told(cls: type[Any], head: str = "Key") -> str:
    """The fields of a class of which only answers are made."""
    return table((head, "Meaning"), ((code(item.name), described(item)) for item, _ in annotated_fields(cls)))


def default_of(item: Field[Any]) -> str:
    if item.default_factory is not MISSING:
        return json.dumps(to_dict(item.default_factory()))
    return "required" if item.default is MISSING else json.dumps(to_dict(item.default))


def described(item: Field[Any]) -> str:
    parts = (in_line(item.metadata.get("description", "")), limits_in_words(item))
    return ". ".join(part for part in parts if part)
