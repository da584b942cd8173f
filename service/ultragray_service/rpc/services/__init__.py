"""The services of ultragray.v1, one module each."""
