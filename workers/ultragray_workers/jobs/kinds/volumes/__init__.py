"""Jobs that make volumes of scenes. Its modules that end in `_run` are imported in the job's process only."""
