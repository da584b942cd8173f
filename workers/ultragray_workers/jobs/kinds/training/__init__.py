"""What a training job does beside the steps: the classical methods to compare with, and how long all of it takes."""
