"""Time and memory of steps on a CPU and on GPUs."""
