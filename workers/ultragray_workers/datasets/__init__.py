"""Datasets that a service was sent: received, unpacked, checked, kept."""
