"""Frames and slices of scenes, one by one."""
