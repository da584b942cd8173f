"""Sequences recorded with PLUS."""

from ultragray.datasets.plus.recording import read_plus_sweep

__all__ = ["read_plus_sweep"]
