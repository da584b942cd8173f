"""The fields that volumes and slices show, and the names of their files. Free of torch."""

from __future__ import annotations

from ultragray.errors import InvalidArgument

VOLUME_FIELDS = ("echo", "coverage", "attenuation", "labels")
VOLUME_SUFFIXES = (".nii.gz", ".nii", ".nrrd")
SLICE_SUFFIXES = (".png", ".npy")


def check_field(field: str, *, has_labels: bool) -> None:
    """Raises InvalidArgument for a field that is none of VOLUME_FIELDS, and for labels of a scene without them."""
    if field not in VOLUME_FIELDS:
        raise InvalidArgument(f"field must be one of {', '.join(VOLUME_FIELDS)}, got {field[:40]!r}", field="field")
    if field == "labels" and not has_labels:
        raise InvalidArgument("labels are for scenes whose Gaussians carry them, this one's carry none", field="field")


def voxel_bytes(field: str) -> int:
    """Bytes of a voxel: labels are uint8, the other fields float32."""
    return 1 if field == "labels" else 4
