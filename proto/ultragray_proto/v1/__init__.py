"""Version 1 of the wire contract (protobuf package ultragray.v1)."""
