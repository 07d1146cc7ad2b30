"""Material point method on a sparse grid: transfers, contact between bodies and with colliders, sensors."""
