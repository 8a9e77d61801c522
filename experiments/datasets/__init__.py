"""What the bundled models are trained on and tested with."""
