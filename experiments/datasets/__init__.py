"""Training and test data of the bundled models."""
