"""PID controllers and balance for bodies under joint torques."""
