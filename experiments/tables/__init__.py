"""What fits and models are measured by."""
