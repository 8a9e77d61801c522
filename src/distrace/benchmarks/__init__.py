"""Measurements of the tracer and of its gradients."""
