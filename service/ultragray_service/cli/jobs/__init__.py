"""`ultragray jobs`: commands for the jobs of a running service."""
