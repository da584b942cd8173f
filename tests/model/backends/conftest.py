"""Probes, cases, and one way to draw by every kernel.

Cases of the CUDA kernels are slow where they are interpreted: `make test` leaves most to `make test-long`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from ultragray import ConvexProbe, ElevationBeam, LinearProbe, PhasedProbe, Probe, RadialProbe, SteeredProbe
from ultragray.rendering.backends import cpu, cuda, reference
from ultragray.rendering.backends.inputs import beam_cm, scene_poses
from ultragray.rendering.limits import UNLIMITED
from ultragray.rendering.outputs import PLANES

LINEAR = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=60.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=60.0)
RADIAL = RadialProbe(near_mm=1.0, far_mm=30.0)
STEERED = SteeredProbe(width_mm=40.0, steering_deg=-30.0, near_mm=0.0, far_mm=50.0)
HEIGHT, WIDTH = 37, 53
KERNELS = ("cuda", *cpu.INSTRUCTION_SETS)
FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=15.0, depth_of_field_mm=12.0)


@dataclass(frozen=True)
class Case:
    """A scene, a probe and poses; images are small, poses many, so that strips and batches are crossed."""

    scene: Mapping[str, Any] = field(default_factory=dict)
    probe: Probe = LINEAR
    height: int = HEIGHT
    width: int = WIDTH
    poses: int = 6
    tilt_deg: float = 20.0
    beam: ElevationBeam | None = None


CASES = {
    "linear": Case(),
    "convex": Case(probe=CONVEX),
    "wide_fan": Case(probe=ConvexProbe(opening_angle_deg=150.0, near_mm=5.0, far_mm=50.0)),
    "face_beyond_apex_zero": Case(probe=ConvexProbe(opening_angle_deg=45.0, near_mm=0.0, far_mm=50.0)),
    "phased": Case(probe=PHASED),
    "phased_at_the_face": Case({"centre_cm": (0, 0, 0.3), "extent_cm": (1, 0.4, 0.8)}, probe=PHASED),
    "radial": Case({"centre_cm": (0, 0, 0)}, probe=RADIAL),
    "radial_about_the_centre": Case({"centre_cm": (0, 0, 0), "extent_cm": (1, 1, 1), "sigma_cm": (0.02, 0.4)}, RADIAL),
    "radial_of_few_lines": Case({"centre_cm": (0, 0, 0)}, probe=RADIAL, width=5),
    "radial_of_two_lines": Case(  # behind each other
        {"count": 300, "centre_cm": (0, 0, 0), "extent_cm": (4, 1, 4), "sigma_cm": (0.02, 0.1)},
        *(RADIAL, 80, 2),
        tilt_deg=0.0,
    ),
    "radial_of_one_line": Case({"centre_cm": (0, 0, 0)}, probe=RADIAL, width=1),
    "radial_of_many_lines": Case({"centre_cm": (0, 0, 0), "count": 600}, probe=RADIAL, width=301, poses=1),
    "steered": Case(probe=SteeredProbe(width_mm=40.0, steering_deg=25.0, near_mm=0.0, far_mm=50.0)),
    "steered_back": Case(probe=SteeredProbe(width_mm=30.0, steering_deg=-40.0, near_mm=5.0, far_mm=50.0)),
    "near_plane_inside": Case(probe=LinearProbe(width_mm=30.0, near_mm=15.0, far_mm=35.0)),
    "at_the_face": Case({"centre_cm": (0, 0, 0.02), "extent_cm": (3, 0.2, 0.3), "sigma_cm": (0.02, 0.3)}, tilt_deg=3.0),
    "large": Case({"count": 40, "sigma_cm": (1.0, 3.0)}),
    "smaller_than_a_pixel": Case({"count": 4000, "sigma_cm": (0.002, 0.01), "extent_cm": (4, 0.6, 5)}, tilt_deg=0.2),
    "needles": Case({"sigma_cm": (0.005, 1.0)}, tilt_deg=90.0),
    "needles_convex": Case({"sigma_cm": (0.005, 1.0)}, probe=CONVEX, tilt_deg=60.0),
    "dense_and_absorbing": Case({"count": 1200, "transmittance_logit": (-6, 0), "sigma_cm": (0.1, 0.3)}, poses=3),
    "transparent": Case({"transmittance_logit": (18.0, 20.0)}),
    "degree_0": Case({"sh_degree": 0}),
    "degree_2": Case({"sh_degree": 2}),
    "degree_3": Case({"sh_degree": 3}),
    "sigmoid": Case({"intensity": "sigmoid", "sh_degree": 1}),
    "sigmoid_degree_3": Case({"intensity": "sigmoid", "sh_degree": 3}, probe=CONVEX),
    "one_pixel": Case({"sigma_cm": (0.2, 0.5)}, height=1, width=1, poses=60),
    "one_row": Case(height=1, width=97, poses=20),
    "one_column": Case(height=97, width=1, poses=20),
    "one_row_convex": Case(probe=CONVEX, height=1, width=97, poses=20),
    "tall": Case(height=301, width=7, poses=2),
    "broad": Case(height=5, width=301, poses=2),
    "many_poses": Case({"count": 60}, height=16, width=16, poses=50, tilt_deg=180.0),
    "linear, focused": Case(beam=FOCUSED),
    "linear, constant": Case(beam=ElevationBeam(thickness_mm=3.0)),
    "convex, focused": Case(probe=CONVEX, beam=FOCUSED),
    "phased, focused": Case({"centre_cm": (0, 0, 1.5)}, probe=PHASED, beam=FOCUSED),
    "radial, focused": Case({"centre_cm": (0, 0, 0)}, probe=RADIAL, beam=FOCUSED),
    "steered, focused": Case(probe=STEERED, beam=FOCUSED),
    "needles, focused": Case({"sigma_cm": (0.01, 1.0)}, beam=FOCUSED),
    "much thicker than the Gaussians": Case({"count": 900}, beam=ElevationBeam(thickness_mm=20.0), poses=2),
}


def drawn(kernel, scene, probe, poses, beam=None, *, size=(HEIGHT, WIDTH), outputs=PLANES):  # [C, 4, 4] mm
    """Outputs by name: of the reference, of CUDA, or of an instruction set of the CPU.

    Poses and the numbers of the beam may be tensors that want a gradient.
    """
    beam = None if beam is None else beam_cm(beam, probe)
    view = (probe, scene_poses(scene, poses), *size, outputs, UNLIMITED, beam)
    if kernel == "cuda":
        return cuda.render_outputs(scene.to(cuda.device()), *view)
    if kernel == "reference":
        return reference.render_outputs(scene, *view)
    return cpu.render_outputs(scene, *view, instruction_set=kernel)


# The cases of tests that stay; of tests that are not here none does. They take most branches of the kernels.
IN_EVERY_RUN = {
    "test_matches_the_reference_in_float64": {"convex", "steered", "sigmoid_degree_3", "convex, focused"},
    "test_all_outputs_match": {"g01"},
    "test_gradients_are_those_of_the_reference_in_float64": {"convex", "convex, focused"},
    "test_sums_and_gradients_are_those_of_the_reference_in_float64": {"linear"},
    "test_the_label_that_weighs_most_is_shown": {"convex"},
    "test_extreme_parameters_stay_exact": {"60.0"},
    "test_extreme_gaussians": {"cuda"},
    "test_the_depth_cull_is_by_the_mean": {"cuda"},
}


def pytest_collection_modifyitems(items):
    if cuda.available() and not cuda.interpreted():
        return
    for item in items:
        test, _, case = item.name.removesuffix("]").partition("[")
        if "cuda" in case.split("-"):
            item.add_marker(pytest.mark.slow)
            if not is_one_of(case, IN_EVERY_RUN.get(test, set())):
                item.add_marker(pytest.mark.long)


def is_one_of(case, names):
    """Whether one of the names stands in a case as a parameter of its own."""
    return any(f"-{name}-" in f"-{case}-" for name in names)
