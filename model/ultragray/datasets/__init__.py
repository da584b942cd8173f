"""Tracked sweeps: reading them, checking them, and the built-in phantom."""

from ultragray.learn.sweep import Dataset, Sweep

__all__ = ["Dataset", "Sweep"]
