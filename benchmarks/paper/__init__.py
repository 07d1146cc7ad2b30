"""The experiments of PIAvatar (Han et al., arXiv 2606.21162)."""
