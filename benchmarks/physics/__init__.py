"""Physics against theory: contact, elastodynamics, bodies under joint torques."""
