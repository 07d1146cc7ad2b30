"""How long a time step may be; in a file of its own, because settings know it before anybody needs Warp."""

#: Largest stable ``c dt / dx`` that was measured (0.84 to 1.04, less near incompressibility).
CFL_STABLE = 0.84
