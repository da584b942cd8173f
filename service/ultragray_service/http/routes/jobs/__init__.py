"""Jobs, trainings, and the workers that do them."""
