"""Render jobs in shards: the queue as an engine of batches.

The job that was submitted is the batch: it lays out a row for each shard, works at them itself, and writes the manifest
when all are done. While shards are free, one *share* of the batch waits in the queue, a task that users do not see: the
worker that takes it puts the next one behind it, and works at the shards, too. So all workers that have nothing else to
do come to help, one at a time, and each keeps the scene loaded between shards. Which shard is whose stands in a table:
a worker that dies loses what it had at hand, and only that is rendered again.
"""
