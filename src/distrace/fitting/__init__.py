"""A code, or a camera, found from depths, silhouettes, points or signed samples."""
