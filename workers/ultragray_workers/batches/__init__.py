"""Batches beyond one process: where their files are kept, and the engine Ray; that of the queue is in jobs.shards."""
