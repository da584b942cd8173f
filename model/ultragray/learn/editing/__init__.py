"""Edits of scenes (`ultragray.scene.edits`), carried out: each gives a new scene."""
