"""Training and batch rendering as durable jobs: what is asked for, the store, and the workers. Free of torch.

Only what `run_job` imports in its own process loads torch. The queue is DBOS: a SQLite file in the artifact folder, or
PostgreSQL. `store` and `supervision` are the two ends: one submits, the other runs.
"""
