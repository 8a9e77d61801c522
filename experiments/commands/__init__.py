"""Commands of `python -m experiments`."""
