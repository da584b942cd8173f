"""What draws the planes of frames: the reference, the C++ kernel of the CPU, the Triton kernels of the GPU."""
