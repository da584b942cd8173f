"""Tracked sweeps: reading them, checking them, and the built-in phantom."""

from .sweep import Dataset, Sweep

__all__ = ["Dataset", "Sweep"]
