"""Time steps: drivers of rod groups and of the coupled system, warm starts, adaptive steps, graphs, state buffers."""
