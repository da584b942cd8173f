"""What the kernel, the service and its clients reach on this machine: `ultragray bench`."""
