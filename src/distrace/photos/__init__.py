"""The code and the placement of a shape, fitted to photographs without depth, and masks only where they are given."""
