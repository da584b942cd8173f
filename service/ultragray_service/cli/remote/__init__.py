"""Commands that ask a running service over HTTP: scenes, datasets, registrations, jobs."""
