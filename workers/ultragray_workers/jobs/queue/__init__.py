"""The queue of jobs: DBOS on a SQLite file or on PostgreSQL, and the heartbeat of its workers. Free of torch."""
