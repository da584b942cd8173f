"""Commands of who looks after a service: keys, backups and the like."""
