"""The physical world of a batch of environments: scene, bodies, props, checks of placements, and the control step."""
