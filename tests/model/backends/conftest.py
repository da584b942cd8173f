"""Probes, and one way to draw by every kernel.

Cases of the CUDA kernels are slow where they are interpreted: `make test` leaves most to `make test-long`.
"""

import pytest

from ultragray import ConvexProbe, LinearProbe, PhasedProbe, RadialProbe, SteeredProbe
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
