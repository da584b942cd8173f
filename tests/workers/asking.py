"""Requests for frames of the small scenes of these tests."""

from ultragray import LinearProbe
from ultragray.rendering.settings import Resolved
from ultragray_workers import Priority, RenderRequest
from ultragray_workers.pool.turns import UNKNOWN_CALLER

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
HEIGHT, WIDTH = 24, 32


def asking(
    scene,
    poses,  # [C, 4, 4] mm
    *,
    priority=Priority.INTERACTIVE,
    deadline=None,
    caller=UNKNOWN_CALLER,
    begin_by=None,
    destination=None,
    **settings,
):
    """A request; what is not given is as the scenes were trained."""
    resolved = Resolved(**{"probe": PROBE, "height": HEIGHT, "width": WIDTH, **settings})
    return RenderRequest(
        scene, resolved, poses, priority, deadline, caller=caller, begin_by=begin_by, destination=destination
    )
