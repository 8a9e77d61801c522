"""Models on disk: ours, DeepSDF's experiments, and other people's dialects of these."""
