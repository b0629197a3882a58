"""What compiled kernels share: compilation and its cache, threads, reused memory."""
