"""Collision: mesh, broad phase, candidate lists, CCD step fractions, contact and friction potentials."""
