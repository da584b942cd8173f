"""Scattering and absorption of the phantom's tissues, and the probe's pulse and beam."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ultragray.datasets.phantom.anatomy import Tissue
from ultragray.datasets.phantom.bone import Floats
from ultragray.probe import FloatArray

SPEED_MM_PER_US = 1.54
FREQUENCY_MHZ = 5.0
FREQUENCIES_MHZ = (3.8, 5.0, 6.2)  # whose echoes a scanner averages for smoother speckle
PULSE_SIGMA_MM = 0.17  # of the echo's envelope, along depth
FOCUS_MM = 32.0
ELEVATION_REACH = 2.5  # standard deviations of the slice


@dataclass(frozen=True)
class Acoustics:
    """Attenuation one way in dB/(cm·MHz); backscattered amplitude in dB over that of muscle."""

    attenuation: float
    backscatter_db: float


ACOUSTICS: dict[Tissue, Acoustics] = {
    Tissue.OUTSIDE: Acoustics(0.0, -math.inf),
    Tissue.SKIN: Acoustics(0.9, 14.0),
    Tissue.FAT: Acoustics(0.5, -4.0),
    Tissue.FASCIA: Acoustics(0.8, 4.0),
    Tissue.MUSCLE: Acoustics(0.6, 0.0),
    Tissue.LIGAMENT: Acoustics(0.8, 4.0),
    Tissue.BONE: Acoustics(20.0, 16.0),
    Tissue.BLOOD: Acoustics(0.15, -34.0),
    Tissue.FLUID: Acoustics(0.02, -28.0),
    Tissue.DISC: Acoustics(0.9, -2.0),
}
COMPENSATED = 0.6  # dB/(cm·MHz) that the scanner's time-gain compensation expects


def round_trip_db_per_mm() -> FloatArray:  # [tissues]
    """The loss of an echo in each tissue over a millimetre of depth, there and back."""
    return np.array([0.2 * FREQUENCY_MHZ * ACOUSTICS[tissue].attenuation for tissue in Tissue])


def backscatter_amplitudes() -> FloatArray:  # [tissues]
    """Amplitude of each tissue's scatterers over those of muscle."""
    return np.array([10.0 ** (ACOUSTICS[tissue].backscatter_db / 20.0) for tissue in Tissue])


def compensated_db_per_mm() -> float:
    """The gain of the time-gain compensation over a millimetre of depth."""
    return 0.2 * FREQUENCY_MHZ * COMPENSATED


def lateral_sigma_mm(depth_mm: Floats) -> Floats:
    """Width of the beam in the image plane, there and back."""
    sigma: Floats = np.hypot(0.34, 0.011 * (depth_mm - FOCUS_MM))
    return sigma


def elevation_sigma_mm(depth_mm: Floats) -> Floats:
    """Thickness of the slice: 1.4 mm at half amplitude in the focus of the lens, more before and behind."""
    sigma: Floats = np.hypot(0.6, 0.022 * (depth_mm - FOCUS_MM))
    return sigma


def elevation_weight(elevation_mm: Floats, depth_mm: Floats) -> Floats:
    """The share of an echo from beside the image plane that the beam leaves."""
    sigmas = elevation_mm / elevation_sigma_mm(depth_mm)
    return np.where(np.abs(sigmas) < ELEVATION_REACH, np.exp(-0.5 * sigmas * sigmas), 0.0)
