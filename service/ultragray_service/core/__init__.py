"""What the front doors share: requests, streams, scenes, datasets, jobs."""
