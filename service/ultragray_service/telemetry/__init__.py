"""Logs, metrics and statistics: what the service says about itself."""
