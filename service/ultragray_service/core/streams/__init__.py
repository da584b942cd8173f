"""Streams of poses for all front doors."""
