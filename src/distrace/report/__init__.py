"""Pages of one file each, to open in a browser."""
