"""Backups of a whole installation: its database, scenes, datasets and jobs, into one folder and back. Free of torch."""
