"""The examples of the documentation. They work when pasted against the demo scene."""

from __future__ import annotations

from typing import Any

DEMO_SCENE = "demo"
DEMO_POSITION_MM = {"x": 0.0, "y": 0.0, "z": 0.0}  # of the probe, in the frame of the demo scene
DEMO_QUATERNION = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}

_POSE = {"position_mm": DEMO_POSITION_MM, "quaternion": DEMO_QUATERNION}

RENDER_EXAMPLES: dict[str, Any] = {
    "one frame": {
        "summary": "One frame, by position and quaternion (image/png by default)",
        "value": {"pose": _POSE},
    },
    "matrix": {
        "summary": "One small frame, by matrix",
        "value": {
            "pose": {
                "matrix": [
                    [1.0, 0.0, 0.0, DEMO_POSITION_MM["x"]],
                    [0.0, 1.0, 0.0, DEMO_POSITION_MM["y"]],
                    [0.0, 0.0, 1.0, DEMO_POSITION_MM["z"]],
                    [0.0, 0.0, 0.0, 1.0],
                ]
            },
            "height": 256,
            "width": 256,
        },
    },
    "batch": {
        "summary": "Two poses 2 mm apart, two outputs (application/x-npz by default)",
        "value": {
            "poses": [
                _POSE,
                {
                    "position_mm": {**DEMO_POSITION_MM, "y": DEMO_POSITION_MM["y"] + 2.0},
                    "quaternion": DEMO_QUATERNION,
                },
            ],
            "outputs": ["bmode", "transmittance"],
        },
    },
    "another probe": {
        "summary": "One frame with a convex probe",
        "value": {
            "pose": _POSE,
            "probe": {"kind": "convex", "opening_angle_deg": 60.0, "near_mm": 10.0, "far_mm": 60.0},
        },
    },
}

JOB_EXAMPLES: dict[str, Any] = {
    "train": {
        "summary": "Train a scene from an uploaded dataset and serve it",
        "value": {
            "kind": "train",
            "specification": {"dataset": "liver", "scene": "liver-1", "settings": {"steps": 500}},
            "request_id": "liver-1",
        },
    },
    "render": {
        "summary": "A hundred frames about the training poses, as a tar of PNGs",
        "value": {
            "kind": "render",
            "specification": {
                "scene": DEMO_SCENE,
                "sampler": {"kind": "around", "count": 100, "translation_mm": 2.0, "rotation_deg": 5.0, "seed": 0},
                "format": "tar",
            },
        },
    },
}

SLICE_EXAMPLES: dict[str, Any] = {
    "a plane parallel to the skin": {
        "summary": "10 mm deep, 50 x 40 mm (image/png by default)",
        "value": {"origin_mm": [-25, -20, 10], "right": [1, 0, 0], "down": [0, 1, 0], "size_mm": [50, 40]},
    },
}
