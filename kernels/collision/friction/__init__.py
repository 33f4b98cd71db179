"""Friction potentials and rotating surfaces."""
