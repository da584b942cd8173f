"""The workers: each takes one job at a time from the queue and supervises its process. Only that one loads torch."""
