"""Derivatives of images held against finite differences, and against those of DIST."""
