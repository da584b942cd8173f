"""Places of scenes: a folder, or a bucket with a cache on this host."""
