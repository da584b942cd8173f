"""Limits of each key: rates, streams, jobs, minutes of compute, bytes."""
