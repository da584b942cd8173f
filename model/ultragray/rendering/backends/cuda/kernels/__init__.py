"""The Triton kernels, in the order in which a frame passes them: slicing, drawing; back: gathering, placing."""
