"""Continuous collision detection: time of impact and step fractions."""
