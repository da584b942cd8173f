"""Contact of a probe with the skin: which scan lines have it, and how tissue gives way to pressure. Needs no torch."""

from ultragray.contact.compression import MOST_COMPRESSION
from ultragray.contact.skin import COUPLING_MM, MARGIN_MM, Skin
from ultragray.contact.touch import Touch

__all__ = ["COUPLING_MM", "MARGIN_MM", "MOST_COMPRESSION", "Skin", "Touch"]
