"""Material point method: continuum physics, batched over environments. Knows nothing of bones or rewards."""
