"""Scenes made from labels (`ultragray.scene.recipes`), which nobody recorded."""
