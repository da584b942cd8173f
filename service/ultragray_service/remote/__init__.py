"""A running service, asked over HTTP with nothing but the standard library: scenes, datasets, jobs, workers."""
