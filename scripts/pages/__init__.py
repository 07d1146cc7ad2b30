"""Parts of the pages of ``docs/envs``: entries, facts, settings, text, pictures."""
