"""Acoustics of tissues: the one table that scenes made from labels, inserted bodies and the abdominal phantom read.

Sources, by the letters of `Tissue.source`:

    A  Diagnostics 13:855 (2023), table 4, doi 10.3390/diagnostics13050855: attenuation in dB/cm at 1 MHz
    B  Sensors 23:5942 (2023), table A2: impedance, from density and speed
    C  Maier et al., Medical Imaging Systems, Springer 2018, table 11.3: share of the power that boundaries reflect,
       from which the impedance of the second material follows by that of the first
    D  Culjat et al., A review of tissue substitutes for ultrasound imaging, Ultrasound Med Biol 36:861 (2010), table 1

Values of A to C were compared with the published tables. Those of D (`is_verified` is false) were not: the paper could
not be read, and of its table the speeds alone are confirmed by others who cite it. What stands for a tissue that no
table names is told beside it.

The echo is a level over liver of what a scanner shows, a matter of convention more than of measurement: such levels
vary more between patients and settings than between tables. Their order is that of textbooks: a renal cortex as bright
as liver or darker, pyramids darker than the cortex, a sinus brighter for its fat; of heart, liver, kidney, spleen and
pancreas liver scatters most (Fei and Shung, J Acoust Soc Am 78:871, 1985).
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Tissue:
    """The acoustics of a tissue."""

    attenuation: float  # one way, dB/(cm MHz)
    echo_db: float  # over soft tissue such as liver
    impedance: float  # MRayl
    texture_db: float = 1.5  # deviation of the echo between places, beside speckle
    source: str = "A"  # of the attenuation, then of the impedance
    is_verified: bool = True


TISSUES = {
    "cyst": Tissue(0.0022, -60.0, 1.46, 0.0, "AB"),  # water
    "blood": Tissue(0.15, -40.0, 1.58, 0.0, "AC"),
    "tumour": Tissue(0.54, -9.0, 1.63, 2.0, "D", is_verified=False),  # attenuation and impedance: mean of soft tissue
    "fat": Tissue(0.63, 6.0, 1.39, 3.0, "AB"),  # in organs, where it is bright
    "tendon": Tissue(4.7, 9.0, 1.84, 3.0, "D", is_verified=False),
    "calcification": Tissue(6.9, 15.0, 6.5, 2.0, "DB", is_verified=False),  # attenuation of cortical bone
    "liver": Tissue(0.5, 0.0, 1.69, 1.0, "AD", is_verified=False),  # impedance
    "spleen": Tissue(0.4, -1.0, 1.64, 1.0, "A", is_verified=False),  # impedance: of soft tissue
    "kidney cortex": Tissue(1.0, -4.0, 1.62, 1.5, "AC"),
    "kidney medulla": Tissue(1.0, -9.0, 1.61, 1.0, "A", is_verified=False),  # impedance: a little below the cortex's
    "renal sinus": Tissue(0.63, 8.0, 1.39, 4.0, "AB"),  # fat
    "muscle": Tissue(0.96, -5.0, 1.68, 4.0, "AB"),  # across its fibres
    "subcutaneous fat": Tissue(0.63, -8.0, 1.39, 3.0, "AB"),
    "connective tissue": Tissue(1.57, 8.0, 1.81, 3.0, "AD", is_verified=False),  # impedance
    "skin": Tissue(0.35, 8.0, 1.99, 1.0, "AB"),
    "bone": Tissue(15.0, 8.0, 6.5, 2.0, "AB"),
    # What shows behind the surface of gas is no tissue but reverberation, which fades with depth: its level and pace,
    # 12 dB/cm there and back at 3.5 MHz, are our choice. A says 7.5 for the sound in the gas itself.
    "gas": Tissue(1.7, 4.0, 0.0004, 5.0, "C", is_verified=False),
}
SOFT_TISSUE_DB = 0.54  # dB/(cm MHz), of D: what the time-gain compensation of a scanner expects
WHOLE_REFLECTION_DB = 42.6  # echo of a plane that reflects all, over liver: bone in muscle then has the phantom's 38


def reflection_db(first: float, second: float) -> float:  # MRayl
    """The echo of a plane boundary, face on, over that of liver; −∞ where nothing changes."""
    share = abs(second - first) / (second + first)
    return WHOLE_REFLECTION_DB + 20.0 * math.log10(share) if share else -math.inf
