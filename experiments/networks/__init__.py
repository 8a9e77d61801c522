"""Networks that start fits: the scans they train on, and their training."""
