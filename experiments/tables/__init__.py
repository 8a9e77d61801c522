"""Tables of fits and of models."""
