"""Received frames in MCAP files. The extra `mcap`."""
