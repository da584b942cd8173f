from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ultragray_workers.jobs.kinds.curve import draw_training_curve


def drawn(folder: Path, lines: list[dict[str, Any]]) -> np.ndarray[Any, Any]:  # [H, W, 3]
    (folder / "journal").write_text("".join(json.dumps(line) + "\n" for line in lines))
    draw_training_curve(folder / "journal", folder / "curve.png")
    picture = cv2.imread(str(folder / "curve.png"))
    assert picture is not None
    return picture


def coloured(picture: np.ndarray[Any, Any]) -> int:
    """How many pixels are of the lines: all else is grey."""
    return int(((picture.max(axis=2).astype(int) - picture.min(axis=2)) > 60).sum())


@pytest.mark.parametrize("steps", [1, 299, 1001])
def test_loss_on_the_left_and_held_out_frames_on_the_right(steps: int, tmp_path: Path) -> None:
    lines: list[dict[str, Any]] = [{"step": step, "loss": 1.0 / step} for step in range(1, steps + 1)]
    alone = drawn(tmp_path, lines)
    assert alone.shape == (300, 1000, 3)
    assert (coloured(alone[:, :500]) > 0) == (steps > 1)
    assert coloured(alone[:, 500:]) == 0
    lines[-1]["val_psnr_db"] = 20.0
    assert coloured(drawn(tmp_path, lines)[:, 500:]) > 0
