"""Pose refinement: the tracker's errors, found from the path of the probe and from the images, and taken out."""
