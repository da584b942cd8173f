"""Tracked sweeps: reading them, checking them, and the built-in phantom."""

from ultragray.datasets.sweep import Dataset, Sweep

__all__ = ["Dataset", "Sweep"]
