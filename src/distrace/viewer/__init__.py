"""A viewer in the browser: a shape that is traced live, on loopback."""
