"""Residuals at dofs, load scales and subset sums."""
