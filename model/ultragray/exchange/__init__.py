"""Scenes and frames for other programs, and from them: exporters, PLY, checkpoints of the released code, ROS
messages, 3D Slicer.
"""
