"""Training and batch rendering as durable jobs: what is asked for, the store, and the workers. Free of torch.

`store` submits and tells, `worker.supervision` runs; between them are the table `jobs` (`queue`, `record`) and the
storage of the files (`files`). Only what `worker.run_job` imports in its own process loads torch.
"""
