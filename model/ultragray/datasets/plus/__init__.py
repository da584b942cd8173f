"""Sequences recorded with PLUS."""

from .recording import read_plus_sweep

__all__ = ["read_plus_sweep"]
