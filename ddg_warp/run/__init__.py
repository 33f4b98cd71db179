"""Scenes by name: simulate, record, draw, bench, check, the command line."""
