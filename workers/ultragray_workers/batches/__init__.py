"""Batches beyond one process: where their files are kept, and the engine Ray; the queue is in kinds.shards_run."""
