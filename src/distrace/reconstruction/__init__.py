"""Shape and colours of any object: networks of its own, fitted to photographs without a prior."""
