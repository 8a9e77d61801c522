"""The default tracer. Read in the order in which a ray lives: bounds, blocks, cones, march, roots, tracer."""
