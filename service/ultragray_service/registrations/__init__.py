"""Registrations of robots and trackers to scenes, kept by name in the installation's database."""
