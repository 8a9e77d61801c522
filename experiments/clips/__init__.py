"""Clips around held-out shapes, by an independent renderer."""
