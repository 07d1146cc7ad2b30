"""Time and memory of steps on a CPU and on GPUs.

- ``vector``: environment steps per second of batches, and memory of an environment.
- ``steps``: control steps and substeps as users reach them, from one environment to large bodies.
- ``cpu``: one environment on one core, beside Gymnasium's ``Humanoid-v5``.
- ``plain_mpm``: a plain MLS-MPM in Taichi or Warp, at the same particle counts.
- ``profile``: time and launches of every kernel of a control step.
- ``soak``: memory and step time over a long run.
- ``timing``: clocks and device memory, which the others use.
"""
