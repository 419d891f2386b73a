"""Fits of axes that the plain terms do not follow: with filter, resonances and lines."""
