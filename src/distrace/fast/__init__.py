"""The tracer that asks least: what a sparse lattice and the pixels beside a ray foretell, one look confirms."""
