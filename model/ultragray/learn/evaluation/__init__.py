"""What a scene, or a classical method, is worth on frames that it never saw."""
