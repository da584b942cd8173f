"""The second echo: beyond a strong interface lies the mirror image of what lies before it."""

import numpy as np
import pytest
import torch

from ultragray import LinearProbe, RadialProbe, render
from ultragray.rendering.overlays import LEAST_DEPTH_MM, add_ghosts
from ultragray.rendering.tools import Needle

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
SIDE = 100  # rows of half a millimetre
INTERFACE, TARGET = 40, 25


def tissue(interface=0.8):
    """Grey tissue with a bright target above a bright interface, behind which half of the beam is left."""
    echo, transmittance = torch.full((1, SIDE, SIDE), 0.2), torch.ones(1, SIDE, SIDE)
    echo[:, TARGET, 40:60] = 0.5
    echo[:, INTERFACE] = interface
    transmittance[:, INTERFACE + 1 :] = 0.5
    return {"echo": echo, "transmittance": transmittance, "bmode": echo * transmittance}


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_the_ghost_of_a_target_is_as_far_beyond_the_interface_as_the_target_is_before_it(share):
    planes, before = tissue(), tissue()
    add_ghosts(planes, PROBE, share)
    ghost = 2 * INTERFACE - TARGET
    assert planes["bmode"][0, ghost, 50] == pytest.approx((1 - share) * 0.1 + share * 0.5)
    assert planes["bmode"][0, ghost, 10] == pytest.approx((1 - share) * 0.1 + share * 0.2)
    assert planes["transmittance"][0, ghost, 50] == pytest.approx((1 - share) * 0.5 + share * 1.0)
    torch.testing.assert_close(planes["bmode"], planes["echo"] * planes["transmittance"])
    for name, plane in planes.items():
        assert torch.equal(plane[:, : INTERFACE + 1], before[name][:, : INTERFACE + 1])
        assert torch.equal(plane[:, 2 * INTERFACE + 1 :], before[name][:, 2 * INTERFACE + 1 :])


def test_a_weak_interface_mirrors_nothing():
    planes, before = tissue(interface=0.55), tissue(interface=0.55)
    add_ghosts(planes, PROBE, 0.5)
    for name, plane in planes.items():
        assert torch.equal(plane, before[name])


def test_bright_lines_at_the_face_mirror_nothing():
    planes, before = tissue(interface=0.2), tissue(interface=0.2)
    for one in (planes, before):
        rows = PROBE.depths_mm(SIDE) < LEAST_DEPTH_MM
        one["echo"][:, rows] = one["bmode"][:, rows] = 0.9
    add_ghosts(planes, PROBE, 0.5)
    for name, plane in planes.items():
        assert torch.equal(plane, before[name])


def test_an_interface_runs_on_through_its_gaps():
    planes, whole = tissue(), tissue()
    planes["echo"][:, INTERFACE, 30] = planes["bmode"][:, INTERFACE, 30] = 0.2
    add_ghosts(planes, PROBE, 0.5)
    add_ghosts(whole, PROBE, 0.5)
    assert torch.equal(planes["bmode"][:, INTERFACE + 1 :], whole["bmode"][:, INTERFACE + 1 :])


@pytest.mark.parametrize(("bright_lines", "mirrors"), [(3, False), (6, True)])
def test_lines_that_go_all_the_way_round_have_no_outermost_one(bright_lines, mirrors):
    turned = []
    for first in (0, 50, 97):
        planes = tissue(interface=0.2)
        bright = (first + np.arange(bright_lines)) % SIDE
        planes["echo"][:, INTERFACE, bright] = planes["bmode"][:, INTERFACE, bright] = 0.95
        planes["echo"][:, TARGET] = planes["bmode"][:, TARGET] = 0.5
        add_ghosts(planes, RadialProbe(near_mm=0.0, far_mm=50.0), 0.5)
        turned.append(planes["bmode"].roll(-first, dims=2))
    assert torch.equal(turned[0], turned[1])
    assert torch.equal(turned[0], turned[2])
    assert bool((turned[0][0, 2 * INTERFACE - TARGET] > 0.2).any()) is mirrors


def test_a_needle_has_a_ghost_below_bone_and_the_frame_without_ghosts_is_as_it_was(random_scene):
    scene = random_scene(1, centre_cm=(0.0, 0.0, -500.0))
    plate = Needle(tip_mm=(30.0, 0.0, 25.0), hub_mm=(-30.0, 0.0, 25.0), diameter_mm=0.5, reverberation=0.0)
    above = Needle(tip_mm=(5.0, 0.0, 15.0), hub_mm=(-5.0, 0.0, 15.0), brightness=0.5, opacity=0.0, reverberation=0.0)
    asked = {"height": SIDE, "width": SIDE, "outputs": ("bmode",), "tools": (plate, above)}
    plain = render(scene, PROBE, np.eye(4), **asked)["bmode"][0, :, SIDE // 2]
    ghosts = render(scene, PROBE, np.eye(4), **asked, ghost=0.5)["bmode"][0, :, SIDE // 2]
    depths = PROBE.depths_mm(SIDE)
    assert depths[60 + ghosts[60:].argmax()] == pytest.approx(35.0, abs=0.8)  # the rows of a surface are two
    assert plain[60:].max() < 1e-6
    assert ghosts[60:].max() == pytest.approx(0.25, abs=0.02)
    without = render(scene, PROBE, np.eye(4), **asked, ghost=0.0)["bmode"][0, :, SIDE // 2]
    assert torch.equal(without, plain)
