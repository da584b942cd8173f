"""Where scenes, datasets and jobs are kept: a folder, or a bucket of an object storage."""
