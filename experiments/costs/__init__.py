"""What tracing and fitting cost."""
