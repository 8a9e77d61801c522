"""The default tracer. Read in the order in which a ray lives: bounds, images, evaluator, march, tracer."""
