"""Costs of tracing and fitting."""
