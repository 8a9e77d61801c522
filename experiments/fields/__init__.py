"""Fields that are hard to trace, and networks without training."""
