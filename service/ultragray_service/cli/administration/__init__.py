"""Commands of who looks after a service: keys, workers, backups and the like."""
