"""The labels of the demo scene, and which tissues of the phantom they stand for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ultragray.phantom import Tissue
from ultragray.phantom.anatomy import LabelArray

LABELS: dict[int, tuple[str, tuple[Tissue, ...]]] = {
    1: ("bone", (Tissue.BONE,)),
    2: ("muscle", (Tissue.MUSCLE,)),
    3: ("fat", (Tissue.FAT,)),
    4: ("vessel", (Tissue.BLOOD,)),
}
LABEL_NAMES = {label: name for label, (name, _) in LABELS.items()}


def labels_of(tissues: npt.NDArray[np.uint8]) -> LabelArray:
    """The label of each `Tissue`, in any shape; 0 for other tissues than those of LABELS."""
    by_tissue = np.zeros(max(Tissue) + 1, np.uint8)
    for label, (_, named) in LABELS.items():
        by_tissue[list(named)] = label
    return by_tissue[tissues]
