"""The front doors of the simulator: HTTP and gRPC in one process, settings, and the command line."""
