"""Shared by the front doors: requests, streams, scenes, datasets, jobs."""
