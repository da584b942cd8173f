"""Scenes made from the labels of the phantoms, as others are from label maps (`ultragray.learn.synthesis`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.synthesis.scene import scene_from_labels
from ultragray.learn.synthesis.space import BodySpace
from ultragray.phantom.abdomen import ABDOMEN, ABDOMEN_PROBE, BODY_NAMES, NAMES
from ultragray.phantom.anatomy import COMPENSATED, FREQUENCY_MHZ, SPINE, Phantom, Tissue
from ultragray.phantom.imaging import DYNAMIC_RANGE_DB, MUSCLE_GREY
from ultragray.phantom.sweeps import PHANTOM_PROBE
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.recipes import SceneRecipe, TissueBody

LOOKS_DB = -1.6  # of the mean of a logarithm of power below that of the mean, with the scanner's three frequencies
RESOLUTION_MM = 0.4
_SPINE_TISSUES: Mapping[Tissue, str] = {
    **{Tissue.SKIN: "skin", Tissue.FAT: "subcutaneous fat", Tissue.FASCIA: "connective tissue"},
    **{Tissue.MUSCLE: "muscle", Tissue.LIGAMENT: "connective tissue", Tissue.BONE: "bone", Tissue.BLOOD: "blood"},
    **{Tissue.FLUID: "cyst", Tissue.DISC: "connective tissue"},
}
# By how much the sheets within a tissue, which no label tells of (septa of fat, fascicles of muscle), brighten its mean
# grey level.
SHEETS_DB: Mapping[Tissue, float] = {Tissue.SKIN: 7.0, Tissue.FAT: 5.8, Tissue.MUSCLE: 6.9}
# Such that two tissues reflect what the phantom's interface between them does.
_IMPEDANCES: Mapping[Tissue, float] = {  # MRayl
    **{Tissue.SKIN: 1.61, Tissue.FAT: 1.39, Tissue.FASCIA: 1.94, Tissue.MUSCLE: 1.61, Tissue.BLOOD: 1.27},
    **{Tissue.FLUID: 1.15, Tissue.DISC: 1.68},
}


def abdomen_recipe(**settings: Any) -> tuple[SceneRecipe, BodySpace]:
    """The recipe of the abdomen, and the space that its bodies lie in."""
    bodies = [
        TissueBody(tissue=name, label=number, name=BODY_NAMES.get(number)) for number, name in enumerate(NAMES, 1)
    ]
    return _recipe(ABDOMEN, bodies, ABDOMEN_PROBE, (-52.0, -64.0, 0.0), (52.0, 64.0, 104.0), settings)


def make_abdomen() -> GaussianScene:
    """The demo scene of the abdomen."""
    recipe, space = abdomen_recipe(level=0.34)
    scene = scene_from_labels(recipe, space=space)
    return replace(scene, info=replace(scene.info, dataset_name="abdomen"))


def spine_recipe(**settings: Any) -> tuple[SceneRecipe, BodySpace]:
    """The same of the spine, with its own acoustics, over those of muscle."""
    bodies = [
        TissueBody(
            tissue=_SPINE_TISSUES[tissue],
            label=int(tissue),
            name=tissue.name.lower(),
            echo_db=SPINE.acoustics[tissue].backscatter_db + SHEETS_DB.get(tissue, 0.0),
            attenuation=SPINE.acoustics[tissue].attenuation,
            impedance=_IMPEDANCES.get(tissue),
        )
        for tissue in Tissue
        if tissue is not Tissue.OUTSIDE
    ]
    return _recipe(SPINE, bodies, PHANTOM_PROBE, (-40.0, -50.0, 0.0), (40.0, 50.0, 64.0), settings)


def _recipe(
    phantom: Phantom,
    bodies: list[TissueBody],
    probe: Probe,
    low_mm: tuple[float, float, float],
    high_mm: tuple[float, float, float],
    settings: Mapping[str, Any],
) -> tuple[SceneRecipe, BodySpace]:
    defaults: dict[str, Any] = {
        "towards": (0.0, 0.0, 1.0),
        "along": (0.0, 1.0, 0.0),
        "frequency_mhz": FREQUENCY_MHZ,
        "dynamic_range_db": DYNAMIC_RANGE_DB,
        "level": MUSCLE_GREY + LOOKS_DB / DYNAMIC_RANGE_DB,
        "compensated": COMPENSATED,
    }
    recipe = SceneRecipe(bodies=tuple(bodies), probe=probe, **{**defaults, **settings})

    def number_at(points: FloatArray) -> Any:
        return phantom.tissue_at(points.astype(np.float32))

    return recipe, BodySpace(recipe.bodies, number_at, np.array(low_mm), np.array(high_mm), RESOLUTION_MM)
