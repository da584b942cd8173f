"""Training: a tracked sweep becomes a scene."""
