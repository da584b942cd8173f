"""What volumes and slices are called in commands. Free of torch."""

VOLUME_FIELDS = ("echo", "coverage", "attenuation", "labels")
VOLUME_SUFFIXES = (".nii.gz", ".nii", ".nrrd")
SLICE_SUFFIXES = (".png", ".npy")
