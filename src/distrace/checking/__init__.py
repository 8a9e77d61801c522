"""Checks derivatives of images against finite differences, and implements DIST's gradient for comparison."""
