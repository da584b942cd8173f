"""The wire contract: stubs generated from proto/ultragray/v1 by proto/generate.py."""
