"""Poses in, frames out: settings, outputs, backends, display, and what is in the image beside the scene. The third
storey.
"""
