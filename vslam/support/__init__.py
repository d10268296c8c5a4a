"""What every part needs and nothing of SLAM: errors, kernels, threads, checks of files."""
