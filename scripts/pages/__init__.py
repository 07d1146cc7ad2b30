"""What the pages of ``docs/envs`` are made of: entries, facts, settings, text, pictures."""
