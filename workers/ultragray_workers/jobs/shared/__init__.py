"""Jobs in a storage that several hosts share: what a worker tells of its job, and where the services read it."""
