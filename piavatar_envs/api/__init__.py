"""Thin views of the batched environment: Gymnasium and its kin."""
