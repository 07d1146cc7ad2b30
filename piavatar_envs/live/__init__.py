"""Interactive play of environments in a web browser: what ``python -m piavatar_envs watch`` runs."""
