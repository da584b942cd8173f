"""The built-in phantom: a lumbar spine in silico, scanned by an image formation of its own.

Nothing here knows of Gaussians or of the renderer: point scatterers under a beam, attenuation marched along each scan
line, an envelope, a log compression. What a scene learns from these sweeps it has learned from speckle.

Frame, mm. x to the patient's right, y caudal, z from the skin into the body; the origin lies on the skin over
the middle vertebra. The vertebrae are 35 mm apart, without end along y.
"""

from ultragray.phantom.anatomy import Tissue, tissue_at
from ultragray.phantom.imaging import bone_attenuation_db, simulate, tissues
from ultragray.phantom.sweeps import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses, load_phantom

__all__ = [
    "PHANTOM_IMAGE_SIDE",
    "PHANTOM_PROBE",
    "Tissue",
    "bone_attenuation_db",
    "freehand_poses",
    "load_phantom",
    "simulate",
    "tissue_at",
    "tissues",
]
