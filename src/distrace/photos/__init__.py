"""A code, and where its shape lies, found from photographs: no depth, no masks."""
