"""`ultragray bench`: what the kernel, the service and the clients reach on this machine."""
