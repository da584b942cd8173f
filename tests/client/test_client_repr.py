"""A frame on a prompt is one line without its pixels."""

from __future__ import annotations

import numpy as np

from ultragray_client import Encoding, Extrapolation, Frame, LinearProbe, Picture, Timings


def test_a_frame() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1.0, -2.25, 30.0]
    frame = Frame(
        arrays={"bmode": np.zeros((512, 256), np.uint8), "echo": np.zeros((512, 256), np.uint8)},
        pose=pose,
        probe=LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0),
        scene="demo",
        scene_sha256="0" * 64,
        renderer="ultragray/0 cpu",
        sequence=1,
        timings=Timings(0.0, 1.0, 0.0),
        extrapolation=Extrapolation(None, None, None, None),
        picture=Picture("mm", 0.0, 0.0, 1.0, 1.0),
        rendered_height=512,
        rendered_width=256,
        slice_thickness_mm=0.0,
        height=512,
        width=256,
        outputs=("bmode", "echo"),
        encoding=Encoding.UINT8,
    )
    assert repr(frame) == "Frame('demo', bmode 512x256, echo 512x256, at (1, -2.25, 30) mm)"
