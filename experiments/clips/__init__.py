"""Images of held-out shapes from all around, by an independent renderer."""
