"""Probes: where each pixel lies in the probe frame.

Convention. Probe frame, right-handed: x lateral (image columns, left to right), y elevation, z axial (depth, image
rows). Origin: centre of the transducer face (linear), apex of the fan (convex), both (phased). Images are [H, W]: H
depth samples, W scan lines; sample i lies at depth near + (far − near)·(i+½)/H along its scan line, so the geometry in
mm does not depend on H.

A kind of probe is one class in one file (`linear.py`): its numbers, and the bundle of scan lines that they mean
(`scan_lines.py`). `Probe` derives the rest, and nothing outside this package asks for a kind.
"""

from ultragray.probe.convex import ConvexProbe
from ultragray.probe.elevation import ElevationBeam
from ultragray.probe.linear import LinearProbe
from ultragray.probe.phased import PhasedProbe
from ultragray.probe.picture import Picture
from ultragray.probe.probe import Probe
from ultragray.probe.radial import RadialProbe
from ultragray.probe.scan_lines import FloatArray
from ultragray.probe.steered import SteeredProbe

__all__ = [
    "ConvexProbe",
    "ElevationBeam",
    "FloatArray",
    "LinearProbe",
    "PhasedProbe",
    "Picture",
    "Probe",
    "RadialProbe",
    "SteeredProbe",
]
