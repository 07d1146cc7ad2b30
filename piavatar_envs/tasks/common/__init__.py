"""Parts that several tasks share: first poses, falls, standing, gaits, balls and gates, thrown balls, rewards."""
