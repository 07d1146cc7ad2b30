"""Pose control: commanded poses become kinematic velocity; begin with :mod:`.controller`, then :mod:`.kernels`."""
