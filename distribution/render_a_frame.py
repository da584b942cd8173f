"""Renders a frame with the installed `ultragray`, which is how a wheel is tried: `python render_a_frame.py`."""

from __future__ import annotations

import platform
import sys
import time

from ultragray import GaussianScene, __version__, render
from ultragray.phantom.demo import DEMO_FILE

began = time.perf_counter()
scene = GaussianScene.load(DEMO_FILE)
frames = render(scene, None, scene.training_poses[:1], height=128, width=128, backend="cpu")
assert frames.bmode is not None
frame = frames.bmode[0]
if tuple(frame.shape) != (128, 128) or not float(frame.std()) > 0.01:
    sys.exit(
        f"error: the frame is blank, or of the wrong size: {tuple(frame.shape)}, deviation {float(frame.std()):.3g}"
    )
took_ms = (time.perf_counter() - began) * 1000
machine = f"Python {platform.python_version()} on {platform.machine()}"
sys.stdout.write(
    f"ultragray {__version__}, {machine}: the demo scene loaded and its first frame rendered in {took_ms:.0f} ms\n"
)
