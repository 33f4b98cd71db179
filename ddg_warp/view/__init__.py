"""Viewer in the browser: recorded and running simulations, on viser (extra `view`)."""
